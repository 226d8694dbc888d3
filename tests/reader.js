// What a reader would mind about a page: words too pale or too small, boxes too narrow, pictures without words. [faults, least contrast]
() => {
  document.querySelectorAll("details").forEach(part => part.open = true);
  const faults = document.querySelector("main h1") ? [] : ["no page"], numbers = text => (text.match(/[\d.]+/g) ?? []).map(Number);
  const light = colour => {
    const [r, g, b] = colour.map(v => v / 255).map(v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4);
    return .2126 * r + .7152 * g + .0722 * b;
  };
  // invert(.93) hue-rotate(180deg), as report.css has it for pictures in the dark.
  const turned = colour => {
    const [r, g, b] = colour.map(v => 255 * .93 - .86 * v);
    return [-.574 * r + 1.43 * g + .144 * b, .426 * r + .43 * g + .144 * b, .426 * r + 1.43 * g - .856 * b]
      .map(v => Math.min(Math.max(v, 0), 255));
  };
  const behind = element => {
    for (let at = element; at; at = at.parentElement) {
      const found = numbers(getComputedStyle(at).backgroundColor);
      if (found.length && found[3] !== 0) return found.slice(0, 3);
    }
    return [255, 255, 255];
  };
  let least = 99;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.data.trim() || !element.checkVisibility() || element.closest("script, style")) continue;
    const look = getComputedStyle(element), svg = element.closest("svg");
    let ink = numbers(svg ? look.fill : look.color).slice(0, 3), paper = behind(element);
    if (svg && getComputedStyle(svg).filter !== "none") ink = turned(ink);
    ink = ink.map((v, k) => v * look.opacity + paper[k] * (1 - look.opacity));
    const [low, high] = [light(ink), light(paper)].sort((a, b) => a - b), ratio = (high + .05) / (low + .05);
    // Letters of a picture are as much smaller as the picture is; of 7 pixels one still tells an 8 from a 3.
    const shown = parseFloat(look.fontSize) * (svg?.getScreenCTM()?.a ?? 1);
    if (shown < 7) faults.push(`${innerWidth} px: letters ${shown.toFixed(1)} px high: ${walker.currentNode.data.slice(0, 40)}`);
    const paperOf = element.closest(".plot > svg:not(.part)")?.getBoundingClientRect(), box = paperOf && element.getBoundingClientRect();
    if (paperOf?.width > 1 && (box.left < paperOf.left - 1 || box.right > paperOf.right + 1))
      faults.push(`${innerWidth} px: cut at the edge of its picture: ${walker.currentNode.data.slice(0, 40)}`);
    const size = parseFloat(look.fontSize), large = !svg && (size >= 24 || size >= 18.66 && look.fontWeight >= 700);
    least = Math.min(least, ratio);
    if (ratio < (large ? 3 : 4.5)) faults.push(`contrast ${ratio.toFixed(2)}: ${walker.currentNode.data.slice(0, 40)}`);
  }
  for (const element of document.querySelectorAll("body, body *:not(svg, svg *)"))
    if (element.checkVisibility() && element.scrollWidth > element.clientWidth + 1 && element.clientWidth > 1
        && getComputedStyle(element).display !== "inline")
      faults.push(`${innerWidth} px: ${element.tagName}.${element.className} is ${element.scrollWidth} wide in ${element.clientWidth}`);
  for (const holder of document.querySelectorAll("figure")) {
    const picture = holder.querySelector(".plot > svg, .plot > img");
    const said = picture?.getAttribute(picture.tagName === "IMG" ? "alt" : "aria-label");
    if (!said) faults.push("a figure without a text alternative");
    if (picture?.tagName !== "svg") continue;
    const words = picture.textContent.replace(/\s+/g, "");
    for (const axes of JSON.parse(holder.querySelector(".plot").dataset.plot).axes)
      for (const name of axes.names)
        if (!words.includes(name.replace(/\s+/g, ""))) faults.push(`not found in the text of the picture: ${name}`);
  }
  return [faults, least];
}
