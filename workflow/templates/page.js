// Values under the pointer, zoom, legend entries to hide, pictures to save. The picture itself is plain SVG: without
// this script it stands as it is. `data-plot` is what workflow/figures/svg.py says of it.
(() => {
"use strict";
const NS = "http://www.w3.org/2000/svg";
const make = (tag, parent, words = "", look = "") => {
  const element = document.createElement(tag);
  element.textContent = words;
  element.className = look;
  parent.append(element);
  return element;
};
// Scales: a value to the length in which its axis is even, and back. A number: linear up to it, logarithmic beyond.
const even = (v, kind) => kind === "lin" ? v : kind === "log" ? Math.log10(v)
  : Math.abs(v) <= kind ? v / kind * 10 / 9 : Math.sign(v) * (10 / 9 + Math.log10(Math.abs(v) / kind));
const back = (t, kind) => kind === "lin" ? t : kind === "log" ? 10 ** t
  : Math.abs(t) <= 10 / 9 ? t * kind * .9 : Math.sign(t) * kind * 10 ** (Math.abs(t) - 10 / 9);
const number = (v, digits = 4) => String(Number(v.toPrecision(digits))).replace("-", "−");
const power = v => {
  const e = Math.round(Math.log10(v));
  return Math.abs(e) <= 3 ? number(v) : "10" + String(e).replace(/./g, c => c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]);
};
const ticks = (low, high, kind) => {
  const decades = kind === "log" ? Math.log10(high / low) : 0;
  if (decades >= .7) {
    const found = [], step = Math.ceil(decades / 8);
    for (let e = Math.floor(Math.log10(low)); e <= Math.log10(high); e += step)
      for (const m of decades < 2 ? [1, 2, 5] : [1]) found.push(m * 10 ** e);
    return found.filter(v => v >= low && v <= high).map(v => [v, decades < 2 ? number(v) : power(v)]);
  }
  if (typeof kind === "number")
    return [0, 1, 2, 3, 4].map(k => back(even(low, kind) + k / 4 * (even(high, kind) - even(low, kind)), kind))
      .map(v => [v, number(v, 3)]);
  const raw = (high - low) / 5, ten = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find(m => m * ten >= raw) * ten, found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push([k * step, number(k * step, 6)]);
  return found;
};
// Lines of a path of relative steps, each a list of points.
const runs = path => {
  const found = [];
  let x = 0, y = 0;
  for (const [, steps, closed] of path.getAttribute("d").matchAll(/m([^mz]*)(z?)/g)) {
    const numbers = steps.match(/-?\d*\.?\d+/g).map(Number), line = [];
    for (let k = 0; k < numbers.length; k += 2) line.push([x += numbers[k], y += numbers[k + 1]]);
    if (closed) line.push([x, y] = line[0]);
    found.push(line);
  }
  return found;
};
// Places of a path of markers: as they stood before any zoom.
const places = path => path.places ??= runs(path).flat();
const at = text => [Number(text.getAttribute("x")), Number(text.getAttribute("y"))];

class Plot {
  constructor(holder) {
    this.holder = holder;
    this.svg = holder.querySelector("svg");
    this.svgs = [this.svg];
    this.plot = JSON.parse(holder.dataset.plot);
    this.hidden = new Set();
    this.view = this.plot.axes.map(() => [[0, 1], [0, 1]]);
    this.panel = 0;
    this.tip = make("div", holder, "", "tip");
    this.tip.setAttribute("role", "status");
    this.tip.hidden = true;
    holder.tabIndex = 0;
    holder.setAttribute("role", "group");
    holder.setAttribute("aria-label", this.svg.getAttribute("aria-label"));
    holder.addEventListener("keydown", event => this.key(event));
    holder.addEventListener("blur", () => this.leave());
    holder.addEventListener("pointerleave", () => this.leave());
    this.listen(this.svg);
    const figure = holder.closest("figure");
    for (const item of figure.querySelectorAll("[data-entry]")) this.entry(item);
    // A figure is saved as it is on a wide screen: parts of it for a narrow one are only seen as a whole again.
    const isPart = holder.classList.contains("narrow");
    const tools = make("p", isPart ? holder : figure, "", "tools"), acts = [["whole", () => this.whole()]];
    if (!isPart) acts.push(["SVG", () => this.save("svg")], ["PNG", () => this.save("png")]);
    for (const [words, act] of acts) make("button", tools, words).addEventListener("click", act);
    tools.firstChild.hidden = true;
    this.reset = tools.firstChild;
  }
  listen(svg) {
    svg.addEventListener("pointermove", event => this.move(svg, event));
    svg.addEventListener("pointerdown", event => this.down(svg, event));
    svg.addEventListener("pointerup", event => this.up(svg, event));
    svg.addEventListener("dblclick", () => this.whole());
  }
  entry(item) {
    const which = item.dataset.entry;
    item.tabIndex = 0;
    item.setAttribute("role", "button");
    item.setAttribute("aria-pressed", "true");
    const toggle = () => {
      const off = !this.hidden.delete(which);
      if (off) this.hidden.add(which);
      item.setAttribute("aria-pressed", String(!off));
      for (const svg of this.svgs) for (const part of svg.querySelectorAll(".k" + which)) part.style.display = off ? "none" : "";
    };
    item.addEventListener("click", toggle);
    item.addEventListener("keydown", event => {
      if (event.key === "Enter" || event.key === " ") { event.preventDefault(); toggle(); }
    });
  }
  // On a narrow screen columns of panels stand below each other, each as a copy of its part of the picture.
  part() {
    if (this.svgs.length > 1 || !this.plot.cuts.length || /wide|narrow/.test(this.holder.className)) return;
    const edges = [0, ...this.plot.cuts, this.plot.width];
    for (let k = 1; k < edges.length; k++) {
      const copy = this.svg.cloneNode(true);
      copy.setAttribute("viewBox", `${edges[k - 1]} 0 ${edges[k] - edges[k - 1]} ${this.plot.height}`);
      copy.setAttribute("class", "part");
      copy.setAttribute("aria-hidden", "true");
      this.svg.parentNode.append(copy);
      this.svgs.push(copy);
      this.listen(copy);
    }
    this.holder.classList.add("parted");
  }
  // What can be read in a panel: {words, lines, marks} by entry; lines without an entry only where nothing has one.
  data(j) {
    this.read ??= [];
    if (this.read[j]) return this.read[j];
    const found = [];
    for (const group of this.svg.querySelectorAll(`.a${j} > [class^=k], .a${j} > .d`)) {
      const entry = group.getAttribute("class").slice(1), lines = [], marks = [];
      for (const path of group.querySelectorAll(".m path")) lines.push(...runs(path));
      // A part for a narrow screen shows lines of the whole picture in its own place.
      for (const again of group.querySelectorAll(".m > use")) {
        const [a, , , d, e, f] = again.getAttribute("transform").slice(7, -1).split(" ").map(Number);
        for (const path of document.querySelectorAll(again.getAttribute("href") + " path"))
          lines.push(...runs(path).map(line => line.map(([x, y]) => [a * x + e, d * y + f])));
      }
      for (const path of group.querySelectorAll(".p")) marks.push(...places(path));
      found.push({entry, words: entry ? this.plot.legend[entry] : "", lines, marks});
    }
    const named = found.filter(item => item.entry);
    return this.read[j] = named.length ? named : found;
  }
  // Length along the picture to value and back; with zoom.
  whereIs(j, dim, value) {
    const {box, x, y} = this.plot.axes[j], [low, high, kind] = dim ? y : x, [a, b] = this.view[j][dim];
    const t = ((even(value, kind) - even(low, kind)) / (even(high, kind) - even(low, kind)) - a) / (b - a);
    return dim ? box[3] - t * (box[3] - box[1]) : box[0] + t * (box[2] - box[0]);
  }
  value(j, dim, place) {
    const {box, x, y} = this.plot.axes[j], [low, high, kind] = dim ? y : x, [a, b] = this.view[j][dim];
    const t = dim ? (box[3] - place) / (box[3] - box[1]) : (place - box[0]) / (box[2] - box[0]);
    return back(even(low, kind) + (a + t * (b - a)) * (even(high, kind) - even(low, kind)), kind);
  }
  // Matrix (scale, shift) of the zoom along x or y.
  zoomed(j, dim) {
    const {box} = this.plot.axes[j], [a, b] = this.view[j][dim], s = 1 / (b - a);
    const from = dim ? box[3] - b * (box[3] - box[1]) : box[0] + a * (box[2] - box[0]);
    return [s, box[dim] - s * from];
  }
  said(j, dim, value) {
    const [, words, unit] = this.plot.axes[j].names[dim].match(/^(.*?)(?:\s*\[(.*)\])?$/);
    return [words, number(value) + (unit && unit !== "1" && unit !== "as logged" ? " " + unit : "")];
  }
  // Show the values at a place of panel j, in units of the picture.
  show(svg, j, px, py) {
    const {box, near} = this.plot.axes[j], [sx, tx] = this.zoomed(j, 0), [sy, ty] = this.zoomed(j, 1);
    const seen = this.data(j).filter(item => !this.hidden.has(item.entry)), rows = [], dots = [];
    const inside = y => y >= box[1] - .5 && y <= box[3] + .5;
    const nearest = (points, reach) => {
      let best = null;
      for (const [x, y] of points) {
        const here = [sx * x + tx, sy * y + ty], far = Math.hypot(here[0] - px, here[1] - py);
        if (far < reach) { reach = far; best = here; }
      }
      return best && [best, reach];
    };
    if (near) {
      const found = seen.map(item => [item, nearest([...item.marks, ...item.lines.flat()], 25)]).filter(([, hit]) => hit)
        .sort((one, other) => one[1][1] - other[1][1])[0];
      if (found) {
        const [x, y] = found[1][0];
        dots.push([x, y]);
        for (const [dim, place] of [[0, x], [1, y]]) rows.push(this.said(j, dim, this.value(j, dim, place)));
        rows.unshift([found[0].words, ""]);
      }
    } else {
      const x = (px - tx) / sx;
      rows.push(this.said(j, 0, this.value(j, 0, px)));
      for (const {words, lines, marks} of seen) {
        let low = Infinity, high = -Infinity;
        for (const line of lines) for (let k = 1; k < line.length; k++) {
          const [[x0, y0], [x1, y1]] = [line[k - 1], line[k]];
          if ((x0 - x) * (x1 - x) > 0) continue;
          for (const y of x0 === x1 ? [y0, y1] : [y0 + (x - x0) / (x1 - x0) * (y1 - y0)]) {
            low = Math.min(low, y);
            high = Math.max(high, y);
          }
        }
        const hit = nearest(marks, 12), name = words || this.said(j, 1, 1)[0];
        if (low <= high) {
          const ends = [high, low].map(y => sy * y + ty);
          if (ends[1] > box[3] + .5 || ends[0] < box[1] - .5) continue;
          const values = ends.map(y => this.said(j, 1, this.value(j, 1, y))[1]);
          dots.push(...ends.filter(inside).map(y => [px, y]));
          const one = () => this.said(j, 1, this.value(j, 1, (ends[0] + ends[1]) / 2))[1];
          rows.push([name, high - low < .3 ? one() : values[0].replace(/ .*/, "") + " to " + values[1]]);
        } else if (hit) {
          dots.push(hit[0]);
          rows.push([name, this.said(j, 1, this.value(j, 1, hit[0][1]))[1] + " at " + this.said(j, 0, this.value(j, 0, hit[0][0]))[1]]);
        }
      }
    }
    this.leave();
    if (!rows.length) return;
    this.panel = j;
    this.cursor = [px, py];
    const mark = document.createElementNS(NS, "g");
    mark.setAttribute("class", "mark");
    const line = document.createElementNS(NS, "path");
    if (!near) line.setAttribute("d", `M${px} ${box[1]}V${box[3]}`);
    mark.append(line, ...dots.map(([x, y]) => {
      const dot = document.createElementNS(NS, "circle");
      for (const [name, value] of [["cx", x], ["cy", y], ["r", 3]]) dot.setAttribute(name, value);
      return dot;
    }));
    svg.append(mark);
    this.tip.replaceChildren();
    for (const [words, value] of rows) {
      const row = make("div", this.tip);
      make("span", row, words);
      make("b", row, value);
    }
    this.tip.hidden = false;
    const frame = this.holder.getBoundingClientRect(), place = svg.getScreenCTM();
    const x = place.a * px + place.e - frame.left, y = place.d * py + place.f - frame.top;
    const left = x + 16 + this.tip.offsetWidth < frame.width ? x + 16 : x - 16 - this.tip.offsetWidth;
    this.tip.style.left = Math.max(0, Math.min(left, frame.width - this.tip.offsetWidth)) + "px";
    this.tip.style.top = Math.max(0, y - this.tip.offsetHeight / 2) + "px";
  }
  leave() {
    this.tip.hidden = true;
    for (const svg of this.svgs) svg.querySelector(".mark")?.remove();
  }
  place(svg, event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const j = this.plot.axes.findLastIndex(({box, second}) =>
      !second && point.x >= box[0] && point.x <= box[2] && point.y >= box[1] && point.y <= box[3]);
    return [j, point.x, point.y];
  }
  move(svg, event) {
    const [j, x, y] = this.place(svg, event);
    if (this.from) return this.stretch(svg, x, y);
    if (j < 0) return this.leave();
    this.show(svg, j, x, y);
  }
  down(svg, event) {
    const [j, x, y] = this.place(svg, event);
    if (j < 0 || event.button || event.pointerType === "touch") return;
    event.preventDefault();
    this.holder.focus({preventScroll: true});
    svg.setPointerCapture(event.pointerId);
    this.from = [j, x, y];
  }
  // The rectangle drawn so far; as high or as wide as the panel where the other way was hardly moved.
  window(x, y) {
    const [j, x0, y0] = this.from, {box} = this.plot.axes[j], few = 8;
    const clip = (v, a, b) => Math.min(Math.max(v, a), b);
    const dx = [x0, clip(x, box[0], box[2])].sort((a, b) => a - b), dy = [y0, clip(y, box[1], box[3])].sort((a, b) => a - b);
    const flat = [dx[1] - dx[0] < few, dy[1] - dy[0] < few];
    return flat[0] && flat[1] ? null : [j, flat[0] ? [box[0], box[2]] : dx, flat[1] ? [box[1], box[3]] : dy];
  }
  stretch(svg, x, y) {
    this.leave();
    const found = this.window(x, y);
    if (!found) return;
    const mark = document.createElementNS(NS, "g"), line = document.createElementNS(NS, "path"), [, [a, b], [c, d]] = found;
    mark.setAttribute("class", "mark");
    line.setAttribute("d", `M${a} ${c}H${b}V${d}H${a}Z`);
    mark.append(line);
    svg.append(mark);
  }
  up(svg, event) {
    if (!this.from) return;
    const [, x, y] = this.place(svg, event), found = this.window(x, y);
    this.from = null;
    this.leave();
    if (!found) return;
    const [j, ...spans] = found, {box} = this.plot.axes[j];
    const part = spans.map((span, dim) => {
      const [a, b] = this.view[j][dim], size = box[dim + 2] - box[dim];
      const t = span.map(v => a + (b - a) * (dim ? box[3] - v : v - box[0]) / size).sort((one, other) => one - other);
      return t[1] - t[0] > 1e-4 ? t : [a, b];
    });
    this.zoom(j, part);
  }
  zoom(j, part) {
    for (const k of this.plot.axes.keys()) for (const dim of [0, 1])
      if (this.plot.axes[k].with[dim] === this.plot.axes[j].with[dim]) this.view[k][dim] = part[dim];
    this.draw();
  }
  whole() {
    this.view = this.plot.axes.map(() => [[0, 1], [0, 1]]);
    this.leave();
    this.draw();
  }
  draw() {
    this.reset.hidden = this.view.flat(2).every((v, k) => v === k % 2);
    for (const svg of this.svgs) svg.classList.toggle("zoomed", !this.reset.hidden);
    for (const svg of this.svgs) for (const j of this.plot.axes.keys()) {
      const [sx, tx] = this.zoomed(j, 0), [sy, ty] = this.zoomed(j, 1), {box} = this.plot.axes[j];
      for (const moving of svg.querySelectorAll(`.a${j} > g > .m`)) {
        moving.setAttribute("transform", `matrix(${sx} 0 0 ${sy} ${tx} ${ty})`);
      }
      // Markers move, but keep their size.
      for (const path of svg.querySelectorAll(`.a${j} > g > .p`)) {
        path.setAttribute("d", "M" + places(path).map(([x, y]) => `${sx * x + tx} ${sy * y + ty}`).join("L"));
      }
      for (const words of svg.querySelectorAll(`.a${j} > .t, .a${j} > .u`)) {
        const text = words.querySelector("text"), fixed = words.getAttribute("class") === "u";
        if (!text) continue;
        const [x, y] = at(text), dx = sx * x + tx - x, dy = fixed ? 0 : sy * y + ty - y;
        words.setAttribute("transform", `translate(${dx} ${dy})`);
        words.style.display = x + dx < box[0] - 5 || x + dx > box[2] || y + dy < box[1] - 15 || y + dy > box[3] + 5 ? "none" : "";
      }
      for (const dim of [0, 1]) this.label(svg, j, dim);
    }
  }
  // Numbers, marks and lines of a zoomed axis, where the first number of the whole one has them.
  label(svg, j, dim) {
    const own = svg.querySelector(`.a${j} > .${"xy"[dim]}`), [a, b] = this.view[j][dim], whole = a === 0 && b === 1;
    own?.nextElementSibling?.dataset.added && own.nextElementSibling.remove();
    if (!own) return;
    own.style.display = whole ? "" : "none";
    if (whole) return;
    const axes = this.plot.axes[j], [low, high] = [axes.box[dim ? 3 : 0], axes.box[dim ? 1 : 2]].map(place => this.value(j, dim, place));
    const group = document.createElementNS(NS, "g"), text = own.querySelector("text");
    group.setAttribute("class", own.getAttribute("class"));
    group.dataset.added = "1";
    const {box, second} = axes, edge = second ? (dim ? box[2] : box[1]) : dim ? box[0] : box[3], out = (dim === 0) === !second ? 3.5 : -3.5;
    const strokes = [["gl", dim ? box[0] : box[1], dim ? box[2] : box[3]], ["tk", edge, edge + out]];
    for (const [value, words] of ticks(Math.min(low, high), Math.max(low, high), (dim ? axes.y : axes.x)[2])) {
      const place = this.whereIs(j, dim, value);
      for (const [look, from, to] of strokes) if (own.querySelector("." + look)) {
        const path = document.createElementNS(NS, "path");
        path.setAttribute("class", look);
        path.setAttribute("d", dim ? `M${from} ${place}H${to}` : `M${place} ${from}V${to}`);
        group.append(path);
      }
      if (!text) continue;
      const label = text.cloneNode(), [x, y] = at(text);
      // The foot of a number beside its mark: as far below as that of the first one.
      label.setAttribute("x", dim ? x : place);
      label.setAttribute("y", dim ? place + 3.2 : y);
      label.textContent = words;
      group.append(label);
    }
    own.after(group);
  }
  key(event) {
    const panels = [...this.plot.axes.keys()].filter(j => !this.plot.axes[j].second);
    if (!panels.includes(this.panel)) this.panel = panels[0];
    const {box, near} = this.plot.axes[this.panel], [px, py] = this.cursor ?? [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    const arrow = {ArrowLeft: -1, ArrowRight: 1}[event.key], turn = {ArrowUp: -1, ArrowDown: 1}[event.key];
    if (arrow && near) {
      const points = this.data(this.panel).filter(item => !this.hidden.has(item.entry)).flatMap(item => [...item.marks, ...item.lines.flat()]);
      this.step = ((this.step ?? -1) + arrow + points.length) % points.length;
      const [x, y] = points[this.step], [sx, tx] = this.zoomed(this.panel, 0), [sy, ty] = this.zoomed(this.panel, 1);
      this.show(this.svg, this.panel, sx * x + tx, sy * y + ty);
    } else if (arrow) {
      const step = (box[2] - box[0]) * (event.shiftKey ? .1 : .01);
      this.show(this.svg, this.panel, Math.min(Math.max(px + arrow * step, box[0]), box[2]), py);
    } else if (turn) {
      this.panel = panels[(panels.indexOf(this.panel) + turn + panels.length) % panels.length];
      const next = this.plot.axes[this.panel].box;
      this.show(this.svg, this.panel, (next[0] + next[2]) / 2, (next[1] + next[3]) / 2);
    } else if (event.key === "+" || event.key === "-") {
      const [a, b] = this.view[this.panel][0], t = a + (b - a) * (px - box[0]) / (box[2] - box[0]);
      const half = Math.min((b - a) * (event.key === "+" ? .25 : 1), .5), low = Math.min(Math.max(t - half, 0), 1 - 2 * half);
      this.zoom(this.panel, [[low, low + 2 * half], this.view[this.panel][1]]);
      this.leave();
    } else if (event.key === "Escape") this.whole();
    else return;
    event.preventDefault();
  }
  // The picture as it stands now, with the styles it takes from the page.
  save(kind) {
    this.leave();
    const copy = this.svg.cloneNode(true), {width, height} = this.plot, style = document.createElementNS(NS, "style");
    style.textContent = "svg{background:#fff} " + document.getElementById("pictures").textContent;
    copy.prepend(style);
    for (const [name, value] of [["xmlns", NS], ["width", width], ["height", height]]) copy.setAttribute(name, value);
    const url = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(new XMLSerializer().serializeToString(copy));
    const give = href => Object.assign(document.createElement("a"), {href, download: `${this.holder.dataset.name}.${kind}`}).click();
    if (kind === "svg") return give(url);
    const image = new Image();
    image.onload = () => {
      const canvas = Object.assign(document.createElement("canvas"), {width: 3 * width, height: 3 * height});
      canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
      give(canvas.toDataURL());
    };
    image.src = url;
  }
}

const plots = [...document.querySelectorAll(".plot[data-plot]")].map(holder => new Plot(holder));
document.getElementById("hint").hidden = !plots.length;
const narrow = matchMedia("(max-width: 640px)");
const part = () => narrow.matches && plots.forEach(plot => plot.part());
narrow.addEventListener("change", part);
part();
// A link to a folded part of the page opens it; paper shows everything.
const open = () => {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let part = target.querySelector("details") ?? target; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true;
  target.scrollIntoView();
};
addEventListener("hashchange", open);
open();
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(part => part.open = true));
})();
