// Sliders to settings, settings to the server, its curves into panels. While a slider moves, the last design is scaled;
// once it is let go, a new one is made, and the one before it is given up.
(() => {
const NS = "http://www.w3.org/2000/svg", TOKEN = new URLSearchParams(location.search).get("token");
const $ = id => document.getElementById(id);
const make = (tag, parent, words = "", about = {}) => {
  const element = document.createElement(tag);
  element.textContent = words;
  for (const [name, value] of Object.entries(about)) element.setAttribute(name, value);
  parent.append(element);
  return element;
};
const draw = (tag, parent, about, words = "") => {
  const element = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(about)) element.setAttribute(name, value);
  element.textContent = words;
  parent.append(element);
  return element;
};
const digits = (v, n = 4) => v == null ? "–" : String(Number(v.toPrecision(n))).replace("-", "−");
const post = async (path, more) => {
  const answer = await fetch(path, {method: "POST", headers: {"X-Flexlink-Token": TOKEN}, body: JSON.stringify(more)});
  const found = await answer.json();
  if (!answer.ok) throw Object.assign(new Error(found.error), {status: answer.status});
  return found;
};

// -- controls: {name: {get, set}} --
const controls = {};
const STEPS = 200;
for (const one of SETTINGS) {
  const stated = one.value != null && (one.kind !== "switch" || one.value) && one.kind !== "choice";
  const row = make("div", $(stated || one.name === "controller_order" ? "stated" : "further"), "", {class: "control"});
  make("label", row, one.name.replace(/(_rad)?_s$/, "").replaceAll("_", " ") + (one.unit ? ` [${one.unit}]` : "") + (one.unasked ? `, or ${one.unasked}` : ""), {for: "c-" + one.name, title: one.words});
  const line = make("div", row), id = "c-" + one.name;
  if (one.kind === "switch" || one.kind === "choice") {
    const box = one.kind === "switch" ? make("input", line, "", {type: "checkbox", id}) : make("select", line, "", {id});
    for (const choice of one.choices ?? []) make("option", box, choice);
    controls[one.name] = one.kind === "switch" ? {get: () => box.checked, set: v => box.checked = v}
      : {get: () => box.value, set: v => box.value = v};
    controls[one.name].set(one.value);
    box.addEventListener("change", () => { follow(); design(); });
    continue;
  }
  const whole = one.kind === "count", top = one.le ?? one.lt, bottom = one.ge ?? one.gt ?? 0;
  const value = one.value === one.unasked ? null : one.value;
  const guess = value ?? (one.name.includes("rad_s") ? 10 : one.name.includes("_s") ? .01 : top === 1 ? .5 : whole ? 5 : 10);
  const log = !whole && !(top <= 1 && bottom < 1 && guess > .02), room = top === undefined ? guess * 20 : top;
  const [low, high] = whole ? [bottom, room] : log ? [guess / 20, Math.min(guess * 20, room)]
    : [bottom + (one.ge === undefined ? .01 : 0), room - (one.le === undefined ? .005 * (room - bottom) : 0)];
  const count = whole ? high - low : STEPS;
  const at = k => whole ? low + k : log ? low * (high / low) ** (k / count) : low + (high - low) * k / count;
  const place = v => Math.round(log ? Math.log(v / low) / Math.log(high / low) * count : (v - low) / (high - low) * count);
  const asked = make("input", line, "", {type: "checkbox", "aria-label": one.name + " is asked"});
  const slider = make("input", line, "", {type: "range", id, min: 0, max: count, step: 1});
  const box = make("input", line, "", {type: "number", step: "any", "aria-label": one.name});
  if (!one.optional) asked.style.visibility = "hidden";
  const get = () => one.optional && !asked.checked ? one.unasked ?? null : Number(box.value);
  const set = v => {
    asked.checked = v != null && v !== one.unasked;
    if (asked.checked || !box.value) box.value = asked.checked ? v : Number(guess.toPrecision(3));
    slider.value = place(Number(box.value));
    slider.setAttribute("aria-valuetext", box.value);
  };
  controls[one.name] = {get, set};
  set(one.value);
  slider.addEventListener("input", () => { set(Number(at(Number(slider.value)).toPrecision(3))); scale(); });
  slider.addEventListener("change", () => design());
  box.addEventListener("change", () => {
    if (!Number.isFinite(parseFloat(box.value))) return $("state").textContent = one.name + ": expected a number";
    set(Number(box.value));
    design();
  });
  asked.addEventListener("change", () => design());
}
// What follows from a structure is said, not set.
const follow = () => {
  for (const one of SETTINGS.filter(one => one.set_by_structure)) {
    const words = one.set_by_structure[controls.structure.get()] ?? "", row = $("c-" + one.name).closest(".control");
    for (const input of row.querySelectorAll("input, select")) input.disabled = !!words;
    (row.querySelector("small") ?? make("small", row)).textContent = words;
  }
};
follow();
const settings = () => Object.fromEntries(Object.entries(controls).map(([name, one]) => [name, one.get()]));
const restore = values => { Object.entries(values).forEach(([name, v]) => controls[name].set(v)); follow(); };

// -- designs --
let shown = null, pinned = null, past = [], number = 0, busy = 0, timer = 0, waiting = false, scaling = false;
const scale = async () => {
  if (scaling) { waiting = true; return; }
  const mine = number;
  scaling = true;
  try {
    const started = performance.now(), found = await post("/scaled", {settings: settings()});
    if (mine === number) {
      show({...shown, ...found, stale: true});
      $("state").textContent = `last design × ${digits(found.gain, 3)} for these settings, not certified`;
      document.body.dataset.scaled = Math.round(performance.now() - started);
    }
  } catch (error) { if (mine === number) $("state").textContent = error.message; }
  scaling = false;
  if (waiting) { waiting = false; scale(); }
};
const design = () => {
  if (shown) show({...shown, stale: true});
  clearTimeout(timer);
  timer = setTimeout(run, 120);  // arrows come in a row
};
const run = async () => {
  const mine = ++number, values = settings(), started = performance.now();
  busy++;
  $("state").textContent = "designing …";
  if (shown) scale();
  try {
    const before = shown?.whole, take = found => {
      const whole = {...found, settings: values, bound: null};
      if (before && past.at(-1) !== before) past.push(before);
      show({...whole, whole});
      return ((performance.now() - started) / 1000).toFixed(1);
    };
    const near = await post("/near", {settings: values});
    if (mine !== number) return;
    if (near.plants) {
      document.body.dataset.near = take(near);
      $("state").textContent = `designed from the last one and certified in ${document.body.dataset.near} s; looking for a better one …`;
    }
    const found = await post("/design", {settings: values});
    if (mine !== number) return;
    const s = take(found);
    $("state").textContent = `designed and certified in ${s} s`;
    document.body.dataset.designed = mine;
    document.body.dataset.seconds = s;
    const bound = await post("/bound", {settings: values});
    if (mine !== number) return;
    shown.bound = shown.whole.bound = bound.reached;
    numbers();
  } catch (error) {
    if (mine !== number || error.status === 409) return;
    if (shown) show({...shown, ...shown.whole, stale: true});
    $("state").textContent = error.status ? error.message : "flexlink tune has stopped: start it again";
    document.body.dataset.failed = mine;
  } finally { busy--; }
};
const undo = () => {
  const before = past.pop();
  if (!before) return;
  number++;
  clearTimeout(timer);
  restore(before.settings);
  show({...before, whole: before});
  $("state").textContent = "undone";
};
const pin = () => {
  pinned = pinned ? null : shown;
  $("pin").setAttribute("aria-pressed", String(!!pinned));
  $("pin").textContent = pinned ? "Unpin" : "Pin this design";
  show(shown);
};
$("undo").addEventListener("click", undo);
$("pin").addEventListener("click", pin);
$("save").addEventListener("click", async () => {
  $("save").disabled = true;
  $("state").textContent = "saving …";
  try {
    const found = await post("/save", {settings: settings(), name: $("name").value});
    $("state").textContent = `saved in ${found.directory}${found.certified ? "" : " (not certified)"}`;
    $("name").value = $("name").value.replace(/\d*$/, n => n ? Number(n) + 1 : "-2");
  } catch (error) { $("state").textContent = error.message; }
  $("save").disabled = false;
});
$("controls").addEventListener("submit", event => event.preventDefault());
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target === $("name")) return;
  const act = {u: undo, p: pin}[event.key.toLowerCase()];
  if (act && !(act === pin && !shown)) { event.preventDefault(); act(); }
});

// -- the page --
const show = found => {
  shown = found;
  $("undo").disabled = !past.length;
  $("pin").disabled = !shown.plants?.length || (shown.stale && !pinned);
  $("panels").classList.toggle("stale", !!shown.stale);
  numbers();
  const names = (shown.plants ?? []).map(one => one.name), chosen = Math.max(0, $("plant").selectedIndex);
  $("plant").hidden = names.length < 2;
  $("plant").replaceChildren();
  names.forEach((name, k) => make("option", $("plant"), name).selected = k === chosen);
  panels();
};
$("plant").addEventListener("change", () => panels());
const numbers = () => {
  const state = shown.certified;
  $("verdict").className = "verdict" + (state ? " certified" : state == null ? " plain" : "");
  $("headline").textContent = state ? "Certified" : state == null ? "Not certified yet" : "Not certified";
  $("numbers").replaceChildren();
  const rows = found => [...found?.numbers ?? [], ["γ of any order, bound", digits(found?.bound)]], other = new Map(rows(pinned));
  for (const [words, value] of rows(shown)) {
    // A sentence has a line of its own, and is no headline.
    const box = make("div", $("numbers"), "", {class: value.length > 30 ? "sentence" : ""});
    make("dt", box, words);
    const cell = make("dd", box, value);
    if (pinned) make("small", cell, "pinned: " + (other.get(words) ?? "–"));
  }
  const box = make("div", $("numbers"), "", {class: "sentence"});
  make("dt", box, "active constraint");
  make("dd", box, shown.stale ? "…" : shown.active || shown.reason || "–");
  $("items").replaceChildren();
  for (const item of shown.stale ? [] : shown.items ?? []) {
    const row = make("tr", $("items"), "", {class: item.met ? "yes" : "no"});
    for (const [head, words] of [["requirement", item.requirement], ["required", item.required], ["achieved", item.achieved], ["met", item.met ? "yes" : "no"]])
      make("td", row, words, {"data-head": head});
  }
};
// Samples of lines with their words: [[look, words], ...].
const keys = (box, samples) => {
  for (const [look, words] of samples) {
    const entry = make("span", box);
    draw("path", draw("svg", entry, {viewBox: "0 0 26 9", "aria-hidden": "true"}), {class: look, d: "M0 5H26"});
    entry.append(words);
  }
};
// One panel: x and y as [low, high, log]; returns places and the group for curves, cut at the frame. key: of its own lines.
const panel = (title, [xl, xh, xlog], [yl, yh, ylog], xwords, even = false, key = []) => {
  const box = make("div", $("panels"));
  make("h2", box, title);
  keys(make("p", box, "", {class: "key"}), key);
  const w = Math.max(box.clientWidth, 240), h = 225, [l, r, t, b] = [46, 8, 8, 34], name = "clip" + $("panels").childElementCount;
  if (even) [xl, xh] = [-1, 1].map(side => (xl + xh) / 2 + side * (yh - yl) * (w - l - r) / (h - t - b) / 2);
  const svg = draw("svg", box, {viewBox: `0 0 ${w} ${h}`, role: "img", "aria-label": title});
  const to = (v, low, high, log) => log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low);
  const x = v => l + (w - l - r) * to(v, xl, xh, xlog), y = v => h - b - (h - t - b) * to(v, yl, yh, ylog);
  draw("rect", draw("clipPath", svg, {id: name}), {x: l, y: t, width: w - l - r, height: h - t - b});
  for (const [low, high, log, across] of [[xl, xh, xlog, true], [yl, yh, ylog, false]]) for (const v of ticks(low, high, log)) {
    const p = across ? x(v) : y(v);
    draw("path", svg, {class: "tick", d: across ? `M${p} ${t}V${h - b}` : `M${l} ${p}H${w - r}`});
    const far = across ? {x: Math.min(p, w - 14), y: h - b + 14, "text-anchor": "middle"} : {x: l - 5, y: p + 4, "text-anchor": "end"};
    draw("text", svg, far, Math.abs(v) > 0 && Math.abs(v) < 1e-3 ? v.toExponential(0).replace("-", "−") : digits(v, 3));
  }
  draw("rect", svg, {class: "frame", x: l, y: t, width: w - l - r, height: h - t - b});
  draw("text", svg, {x: (l + w - r) / 2, y: h - 4, "text-anchor": "middle"}, xwords);
  return [x, y, draw("g", svg, {"clip-path": `url(#${name})`})];
};
const ticks = (low, high, log) => {
  const found = [];
  if (log) {
    const step = Math.max(1, Math.ceil(Math.log10(high / low) / 6));
    for (let e = Math.ceil(Math.log10(low) - 1e-9); e <= Math.log10(high) + 1e-9; e += step) found.push(10 ** e);
    if (found.length > 1) return found;
    return ticks(low, high, false);
  }
  const raw = (high - low) / 5, ten = 10 ** Math.floor(Math.log10(raw)), step = [1, 2, 5, 10].find(m => m * ten >= raw) * ten;
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return found;
};
const path = (xs, ys, x, y) => {
  let d = "", pen = "M";
  xs.forEach((v, k) => {
    if (v == null || ys[k] == null || !(Number.isFinite(y(ys[k])))) { pen = "M"; return; }
    d += `${pen}${x(v).toFixed(1)} ${y(ys[k]).toFixed(1)}`;
    pen = "L";
  });
  return d;
};
// Bode of loop, plant and controller, a panel for each gain, as each has a unit of its own; and poles and zeros.
const views = (plant, other) => {
  const bode = plant.bode, ends = [bode.x[0], bode.x.at(-1), true], span = curves => {
    const seen = curves.flat().filter(v => v != null);
    return [Math.min(...seen), Math.max(...seen)];
  };
  const level = (x, y, group, at) => draw("path", group, {class: "curve limit", d: `M${x(ends[0])} ${y(at)}H${x(ends[1])}`});
  bode.curves.forEach((one, k) => {
    // Whole but for what rounding leaves of a zero.
    const [least, most] = span([one.gain.filter(v => v > 0)]);
    const [x, y, group] = panel(`Bode: gain of ${one.symbol} [${one.unit}]`, ends, [Math.max(least / 1.5, most * 1e-13), most * 1.5, true], "frequency [rad/s]");
    if (one.symbol === "K G") level(x, y, group, 1);
    if (other) draw("path", group, {class: "curve pinned", d: path(other.bode.x, other.bode.curves[k].gain, x, y)});
    draw("path", group, {class: "curve nominal", d: path(bode.x, one.gain, x, y)});
  });
  const looks = ["nominal", "dotted", "worst"], [least, most] = span(bode.curves.map(one => one.deg));
  const [px, py, phases] = panel("Bode: phase [deg]", ends, [Math.min(least, -180) - 10, most + 10, false], "frequency [rad/s]", false,
    bode.curves.map((one, k) => [looks[k], one.symbol]));
  level(px, py, phases, -180);
  if (other) draw("path", phases, {class: "curve pinned", d: path(other.bode.x, other.bode.curves[0].deg, px, py)});
  bode.curves.forEach((one, k) => draw("path", phases, {class: "curve " + looks[k], d: path(bode.x, one.deg, px, py)}));
  const [x, y, group] = panel("Poles (×) and zeros (○) in z: imaginary over real part", [-1.2, 1.2, false], [-1.15, 1.15, false], "real part", true,
    [["worst", "closed loop"], ["nominal", "controller"], ["dotted", "plant"], ["pinned", "unit circle"]]);
  const turn = [...Array(61).keys()].map(k => k * Math.PI / 30);
  draw("path", group, {class: "curve pinned", d: path(turn.map(Math.cos), turn.map(Math.sin), x, y)});
  for (const [name, [re, im]] of Object.entries(plant.roots)) {
    const look = {loop: "worst", controller: "nominal", plant: "dotted"}[name.split(" ")[0]];
    re.forEach((v, k) => {
      const [cx, cy] = [x(v), y(im[k])], cross = `M${cx - 4} ${cy - 4}l8 8m0 -8l-8 8`;
      const mark = name.endsWith("zeros") ? draw("circle", group, {class: "curve " + look, cx, cy, r: 4}) : draw("path", group, {class: "curve " + look, d: cross});
      draw("title", mark, {}, `${name.slice(0, -1)}: ${digits(v, 5)} ± ${digits(Math.abs(im[k]), 4)} j`);
    });
  }
};
// Ends of an axis with a little room beside the values, in whatever unit these are.
const around = values => {
  const [low, high] = [Math.min(...values), Math.max(...values)], room = .06 * (high - low || Math.abs(high) || 1);
  return [low - room, high + room, false];
};
const panels = () => {
  const at = Math.max(0, $("plant").selectedIndex), plant = shown.plants?.[at], other = pinned?.plants?.[at];
  const top = scrollY;
  $("panels").replaceChildren();
  if (!plant) return;
  plant.gains.forEach((one, k) => {
    const seen = [...one.nominal, ...one.worst, ...one.limit].filter(v => v > 0), most = 2 * Math.max(...one.nominal, ...one.worst.filter(v => v < 300 * Math.max(...one.nominal)));
    const ys = [Math.max(Math.min(...seen) / 1.5, most * 1e-5), most, true];
    const [x, y, group] = panel(`${one.symbol} [${one.unit}]: ${one.meaning}`, [one.x[0], one.x.at(-1), true], ys, "frequency [rad/s]");
    const back = [...one.x].reverse(), low = path(back, [...one.nominal].reverse(), x, y).replace("M", "L");
    draw("path", group, {class: "band", d: path(one.x, one.worst.map(v => v ?? most), x, y) + low + "Z"});
    if (other) draw("path", group, {class: "curve pinned", d: path(other.gains[k].x, other.gains[k].worst, x, y)});
    for (const kind of ["worst", "nominal", "limit"]) draw("path", group, {class: "curve " + kind, d: path(one.x, one[kind], x, y)});
  });
  views(plant, other);
  const size = 2.2, [nx, ny, group] = panel("Nyquist: K G and its ellipses, imaginary over real part", [-2.6, 1.8, false], [-size, size / 2, false], "real part", true);
  const radius = controls.modulus_margin?.get() ?? 0, turn = [...Array(61).keys()].map(k => k * Math.PI / 30);
  draw("path", group, {class: "curve limit", d: path(turn.map(v => radius * Math.cos(v) - 1), turn.map(v => radius * Math.sin(v)), nx, ny)});
  for (const [re, im] of plant.nyquist.ellipses) draw("path", group, {class: "band", d: path(re, im, nx, ny) + "Z"});
  if (other) draw("path", group, {class: "curve pinned", d: path(other.nyquist.re, other.nyquist.im, nx, ny)});
  draw("path", group, {class: "curve nominal", d: path(plant.nyquist.re, plant.nyquist.im, nx, ny)});
  draw("circle", group, {class: "point", cx: nx(-1), cy: ny(0), r: 3});
  const step = plant.step;
  if (step.end) {
    const all = [...step.nominal.y, ...step.samples.flatMap(one => one.y), 0], end = step.end;
    const [x, y, inside] = panel("Step of the reference, models from the posterior" + UNIT, [0, end, false], around(all), "time [s]");
    for (const one of step.samples) draw("path", inside, {class: "curve thin", d: path(one.x, one.y, x, y)});
    if (other?.step.end) draw("path", inside, {class: "curve pinned", d: path(other.step.nominal.x, other.step.nominal.y, x, y)});
    draw("path", inside, {class: "curve nominal", d: path(step.nominal.x, step.nominal.y, x, y)});
  }
  if (step.friction.length) {
    const all = [...step.nominal.y, ...step.friction.flatMap(one => one.y), 0];
    const [x, y, inside] = panel("Step with dry friction" + UNIT, [0, step.end, false], around(all), "time [s]", false,
      [["limit", "without feed-forward"], ["nominal", "with feed-forward"], ["worst thin", "nominal, no friction"], ["pinned", "reference"]]);
    draw("path", inside, {class: "curve pinned", d: `M${x(0)} ${y(STEP)}H${x(step.end)}`});
    draw("path", inside, {class: "curve thin", d: path(step.nominal.x, step.nominal.y, x, y)});
    step.friction.forEach((one, k) => draw("path", inside, {class: k ? "curve nominal" : "curve limit", d: path(one.x, one.y, x, y)}));
  }
  scrollTo(scrollX, top);
};
keys($("key"), [["nominal", "nominal"], ["worst", "largest over the ellipses"], ["limit", "specification"], ["pinned", "pinned design (largest over the ellipses; nominal loop and step)"]]);
addEventListener("resize", () => shown && panels());
run();
})();
