"use strict";
// One function of time, `seek`, moves everything: the pose, its forces, the lines in the plots, the numbers beside them.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

function shape(name, attributes, parent) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (parent) parent.append(made);
  return made;
}

const contactColour = (contact) => `var(--contact${contact.style[0]})`;
const dashes = (contact, width) => data.dashes[contact.style[1]].map((d) => d * width).join(" ") || "none";
const interpolate = (a, b, fraction) => (a === null || b === null ? null : a + (b - a) * fraction);
const interpolateAll = (a, b, fraction) => a.map((v, k) => (Array.isArray(v) ? interpolateAll(v, b[k], fraction) : interpolate(v, b[k], fraction)));

// The plan at one time, linear between samples; at a change of formation the new one holds.
function momentAt(time) {
  let phase = data.phases[0];
  for (const one of data.phases) if (one.t[0] <= time) phase = one;
  const t = phase.t;
  let low = 0, high = t.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (t[middle] <= time) low = middle; else high = middle;
  }
  const width = t[high] - t[low];
  const fraction = width > 0 ? Math.min(1, Math.max(0, (time - t[low]) / width)) : 0;
  const at = (name) => interpolateAll(phase[name][low], phase[name][high], fraction);
  return { phase, z: at("z"), tau: at("tau"), cn: at("cn"), ct: at("ct"), places: at("places") };
}

// --- the hand and the object ---------------------------------------------------------------------------------------

const forceLargest = Math.max(0, ...data.phases.flatMap((p) => p.cn.flat()));
const reach = Math.max(...data.hand.length);
const metresPerNewton = forceLargest > 0 ? 0.45 * reach / forceLargest : 0;

function outline(z) {
  const c = Math.cos(z[2]), s = Math.sin(z[2]);
  return data.vertices.map(([x, y]) => [z[0] + c * x - s * y, z[1] + s * x + c * y]);
}

function finger(k, z) {
  const [jx, jy] = data.hand.joint[k], direction = [Math.cos(z[3 + k]), Math.sin(z[3 + k])];
  const side = (k === 0 ? 1 : -1) * data.hand.offset[k];
  const base = [jx - side * direction[1], jy + side * direction[0]];
  return [base, [base[0] + data.hand.length[k] * direction[0], base[1] + data.hand.length[k] * direction[1]]];
}

// The force on the object at contact k, as metres on the page.
function arrow(moment, k) {
  const cn = moment.cn[k], ct = moment.ct[k], [, , nx, ny] = moment.places[k];
  return [cn * nx + ct * ny, cn * ny - ct * nx].map((v) => v * metresPerNewton);
}

// A view that holds the hand and the object at all times, and their forces where these are to be seen.
function viewOf(forces) {
  const points = data.hand.joint.slice(), pad = 0.06 * reach;
  for (const phase of data.phases) phase.z.forEach((z, j) => {
    points.push(...outline(z), ...finger(0, z), ...finger(1, z));
    if (!forces) return;
    const moment = { cn: phase.cn[j], ct: phase.ct[j], places: phase.places[j] };
    moment.places.forEach(([x, y], k) => {
      const [fx, fy] = arrow(moment, k);
      points.push([x - fx, y - fy]);
    });
  });
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  const left = Math.min(...xs) - pad, high = Math.max(...ys) + pad;
  return [left, -high, Math.max(...xs) + pad - left, high - Math.min(...ys) + pad];
}

const scale = 1000; // drawings are in millimetres, `y` down
const to = ([x, y]) => [x * scale, -y * scale];
const show = (svg, view) => svg.setAttribute("viewBox", view.map((v) => v * scale).join(" "));
const path = (points) => points.map((p) => p.map((v) => v.toFixed(2)).join(" ")).join(" L ");

function drawHand(svg, z, numbers) {
  svg.replaceChildren();
  const palm = [data.hand.joint[1], data.hand.joint[0]].map(to);
  shape("path", { d: `M ${path(palm)}`, stroke: "var(--ink)", "stroke-width": 2.5 }, svg);
  const corners = outline(z);
  shape("path", { d: `M ${path(corners.map(to))} Z`, fill: "var(--fill)", stroke: "var(--ink)", "stroke-width": 1 }, svg);
  for (const k of [0, 1]) {
    const colour = `var(--finger${k + 1})`, [cx, cy] = to(data.hand.joint[k]);
    shape("path", { d: `M ${path(finger(k, z).map(to))}`, stroke: colour, "stroke-width": 2.5, "stroke-linecap": "round" }, svg);
    shape("circle", { cx, cy, r: 3, fill: colour }, svg);
  }
  const [x, y] = to(z);
  shape("path", { d: `M ${x - 2.5} ${y} h 5 M ${x} ${y - 2.5} v 5`, stroke: "var(--ink)", "stroke-width": 0.7 }, svg);
  if (numbers) corners.forEach((p, k) => {
    const at = to([p[0] + 0.22 * (z[0] - p[0]), p[1] + 0.22 * (z[1] - p[1])]);
    const label = shape("text", { x: at[0], y: at[1], style: "font-size: 5px", "text-anchor": "middle", "dominant-baseline": "central" }, svg);
    label.textContent = k;
  });
}

// Arrows end where the link touches the object, so that they point where it pushes.
function drawForces(svg, moment) {
  moment.phase.contacts.forEach((contact, k) => {
    const [x, y] = moment.places[k];
    const colour = contactColour(contact), [cx, cy] = to([x, y]);
    shape("circle", { cx, cy, r: 1.8, fill: colour, stroke: "var(--paper)", "stroke-width": 0.5 }, svg);
    if (moment.cn[k] === null) return; // friction holds the object at rest: the forces are not determined
    const force = arrow(moment, k), length = Math.hypot(...force);
    if (length < 1e-4) return;
    const direction = force.map((v) => v / length), head = Math.min(5e-3, length);
    const tail = [x - force[0], y - force[1]], neck = [x - head * direction[0], y - head * direction[1]];
    const wing = (side) => [neck[0] - side * 0.4 * head * direction[1], neck[1] + side * 0.4 * head * direction[0]];
    const group = shape("g", { class: "force" }, svg);
    shape("path", { d: `M ${path([tail, neck].map(to))}`, stroke: colour, "stroke-width": 1.5 }, group);
    shape("path", { d: `M ${path([[x, y], wing(1), wing(-1)].map(to))} Z`, fill: colour }, group);
    shape("title", {}, group).textContent = `${contact.name}: ${moment.cn[k].toPrecision(4)} N`;
  });
}

// --- plots ---------------------------------------------------------------------------------------------------------

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((m) => m * power >= rough);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) values.push(k * step);
  return { step, values, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

// A plot: `curves` of {t, v, colour, dash, width}, `levels` of {v, colour, dash}; returns the line that shows the time.
function plot(svg, curves, levels, dot) {
  const width = Math.max(240, svg.parentElement.clientWidth), height = width < 480 ? 140 : 210;
  const edge = { left: 40, right: 8, top: 18, bottom: 24 };
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.replaceChildren();
  const values = [...curves.flatMap((c) => c.v), ...levels.map((l) => l.v), 0].filter((v) => v !== null);
  const span = Math.max(...values) - Math.min(...values) || 1;
  const low = Math.min(...values) - 0.05 * span, high = Math.max(...values) + 0.05 * span;
  const x = (t) => edge.left + (width - edge.left - edge.right) * t / (data.end || 1);
  const y = (v) => height - edge.bottom - (height - edge.top - edge.bottom) * (v - low) / (high - low);
  const up = ticks(low, high, 5);
  for (const v of up.values) {
    shape("path", { d: `M ${edge.left} ${y(v)} H ${width - edge.right}`, stroke: "var(--line)", "stroke-width": v === 0 ? 1.5 : 0.75 }, svg);
    shape("text", { x: edge.left - 5, y: y(v) + 4, "text-anchor": "end" }, svg).textContent = v.toFixed(up.digits).replace("-", "\u2212");
  }
  const across = ticks(0, data.end || 1, width / 90);
  for (const t of across.values) {
    const last = t === across.values.at(-1), anchor = last && x(t) > width - 40 ? "end" : "middle";
    shape("text", { x: x(t), y: height - 7, "text-anchor": anchor }, svg).textContent = t.toFixed(across.digits) + (last ? " s" : "");
  }
  data.phases.forEach((phase, k) => {
    const end = k + 1 < data.phases.length ? data.phases[k + 1].t[0] : data.end;
    if (k > 0) shape("path", { d: `M ${x(phase.t[0])} ${edge.top - 4} V ${height - edge.bottom}`, stroke: "var(--faint)", "stroke-dasharray": "1 3" }, svg);
    const label = shape("text", { x: x((phase.t[0] + end) / 2), y: 12, "text-anchor": "middle", "font-style": "italic" }, svg);
    label.textContent = phase.name;
    if (label.getComputedTextLength() > x(end) - x(phase.t[0])) label.remove();
  });
  for (const level of levels) shape("path", { d: `M ${x(0)} ${y(level.v)} H ${x(data.end)}`, stroke: level.colour, "stroke-dasharray": "1 3" }, svg);
  for (const curve of curves) {
    let d = "", pen = "M";
    curve.t.forEach((t, k) => {
      if (curve.v[k] === null) { pen = "M"; return; }
      d += `${pen} ${x(t).toFixed(2)} ${y(curve.v[k]).toFixed(2)} `;
      pen = "L";
    });
    shape("path", { d, fill: "none", stroke: curve.colour, "stroke-width": curve.width, "stroke-dasharray": curve.dash, "stroke-linejoin": "round" }, svg);
  }
  if (dot && dot.t <= data.end) shape("circle", { cx: x(dot.t), cy: y(dot.v), r: 4, fill: "var(--ink)", stroke: "var(--paper)" }, svg);
  const line = shape("path", { class: "now", stroke: "var(--accent)", "stroke-width": 1.5 }, svg);
  svg.timeAt = (clientX) => {
    const box = svg.getBoundingClientRect();
    return data.end * ((clientX - box.left) * width / box.width - edge.left) / (width - edge.left - edge.right);
  };
  return (time) => line.setAttribute("d", `M ${x(time)} ${edge.top - 4} V ${height - edge.bottom}`);
}

function legend(list, entries) {
  list.replaceChildren();
  return entries.map((entry) => {
    const item = document.createElement("li"), value = document.createElement("b");
    const key = shape("svg", { viewBox: "0 0 26 8", "aria-hidden": "true" }, item);
    shape("path", { d: "M 0 4 H 26", stroke: entry.colour, "stroke-width": 2, "stroke-dasharray": entry.dash }, key);
    item.append(entry.name, value);
    list.append(item);
    return value;
  });
}

const contactsOfPlan = [...new Map(data.phases.flatMap((p) => p.contacts).map((c) => [c.name, c])).values()];

function torquePlot() {
  const styles = [0, 1].map((k) => ({ name: `finger ${k + 1}`, colour: `var(--finger${k + 1})`, dash: k ? "7 3" : "none" }));
  const curves = styles.map((style, k) => ({ ...style, t: data.torque.t, v: data.torque.tau.map((row) => row[k]), width: 1.75 }));
  const levels = data.hand.torque_limit.flatMap((limit, k) => [-1, 1].map((sign) => ({ v: sign * limit, colour: styles[k].colour })));
  const move = plot(byId("torques"), curves, levels);
  const values = legend(byId("torque-legend"), styles);
  return (time, moment) => {
    move(time);
    values.forEach((value, k) => { value.textContent = moment.tau[k] === null ? "" : moment.tau[k].toFixed(3).replace("-", "\u2212"); });
  };
}

function forcePlot() {
  const curves = data.phases.flatMap((phase) => phase.contacts.flatMap((contact, k) => {
    const style = { t: phase.t, colour: contactColour(contact) };
    const pressed = { ...style, v: phase.cn.map((row) => row[k]), dash: dashes(contact, 1.75), width: 1.75 };
    if (!contact.rolls) return [pressed];
    const inside = phase.cn.map((row, j) => (row[k] === null ? null : contact.friction * row[k] - Math.abs(phase.ct[j][k])));
    return [pressed, { ...style, v: inside, dash: "2 2.5", width: 1.75 }];
  }));
  const dot = data.margin && { t: data.margin.margin_time, v: data.margin.margin };
  const move = plot(byId("forces"), curves, [], dot);
  const named = contactsOfPlan.map((c) => ({ name: c.name, colour: contactColour(c), dash: dashes(c, 2) }));
  const values = legend(byId("force-legend"), named);
  return (time, moment) => {
    move(time);
    contactsOfPlan.forEach((contact, k) => {
      const place = moment.phase.contacts.findIndex((c) => c.name === contact.name);
      const force = place < 0 ? null : moment.cn[place];
      values[k].textContent = force === null ? "\u2013" : force.toFixed(2).replace("-", "\u2212");
    });
  };
}

// --- time ----------------------------------------------------------------------------------------------------------

function start() {
  const slider = byId("time"), play = byId("play"), rate = byId("rate");
  let now = 0, last = null, plots = [], width = 0;
  slider.max = data.end;
  show(byId("scene"), viewOf(true));

  function seek(time) {
    now = Math.min(data.end, Math.max(0, time));
    const moment = momentAt(now), spoken = `${now.toFixed(3)} s`;
    slider.value = now;
    slider.setAttribute("aria-valuetext", `${spoken}, ${moment.phase.name}`);
    byId("clock").textContent = spoken;
    drawHand(byId("scene"), moment.z, true);
    drawForces(byId("scene"), moment);
    for (const update of plots) update(now, moment);
  }

  function tick(stamp) {
    if (last === null) return;
    const next = now + Number(rate.value) * Math.max(0, stamp - last) / 1000;
    last = stamp;
    seek(next);
    if (now >= data.end) pause(); else requestAnimationFrame(tick);
  }

  function pause() {
    last = null;
    play.textContent = "\u25b6";
    play.setAttribute("aria-label", "Play");
  }

  function run() {
    if (now >= data.end) seek(0);
    play.textContent = "\u23f8";
    play.setAttribute("aria-label", "Pause");
    last = performance.now();
    requestAnimationFrame(tick);
  }

  function rebuild() {
    if (byId("torques").parentElement.clientWidth === width) return;
    width = byId("torques").parentElement.clientWidth;
    plots = [torquePlot(), forcePlot()];
    seek(now);
  }

  play.addEventListener("click", () => (last === null ? run() : pause()));
  slider.addEventListener("input", () => { pause(); seek(Number(slider.value)); });
  for (const svg of [byId("torques"), byId("forces")]) {
    const scrub = (event) => { if (event.buttons & 1) { pause(); seek(svg.timeAt(event.clientX)); } };
    svg.addEventListener("pointerdown", scrub);
    svg.addEventListener("pointermove", scrub);
  }
  const newton = 10 ** Math.floor(Math.log10(forceLargest));
  const scaleText = forceLargest > 0
    ? `${newton} N is as long as ${(1000 * metresPerNewton * newton).toFixed(1)} mm.`
    : "Friction holds the object at rest: the forces are not determined.";
  for (const place of document.querySelectorAll(".scale")) place.textContent = scaleText;
  strip((time) => { pause(); seek(time); });
  new ResizeObserver(rebuild).observe(byId("torques").parentElement);
  rebuild();
}

function strip(go) {
  const view = viewOf(false);
  for (const phase of data.phases) {
    const row = document.createElement("div"), title = document.createElement("p"), poses = document.createElement("div");
    row.className = "row";
    title.textContent = phase.name;
    poses.className = "poses";
    row.append(title, poses);
    byId("strip").append(row);
    for (let k = 0; k < 4; k += 1) {
      const at = Math.round(k * (phase.t.length - 1) / 3), button = document.createElement("button");
      const svg = shape("svg", { "aria-hidden": "true" }, button);
      show(svg, view);
      drawHand(svg, phase.z[at], false);
      button.type = "button";
      button.append(`t = ${phase.t[at].toFixed(2)} s`);
      button.addEventListener("click", () => go(phase.t[at]));
      poses.append(button);
    }
  }
}

if (data.phases.length > 0) start();
