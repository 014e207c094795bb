"use strict";
(function () {
  const root = document.getElementById("explorer-panels");
  if (!root) return;
  const panels = JSON.parse(document.getElementById("explorer-data").textContent);
  const people = [...new Set(panels.flatMap(panel => panel.points.map(point => point[0])))];
  const conditions = [...new Set(panels.flatMap(panel => panel.columns.map(column => column[0])))];
  const off = new Set();
  const NS = "http://www.w3.org/2000/svg", WIDTH = 300, HEIGHT = 190, BOX = { left: 44, right: 292, top: 26, bottom: 160 };
  const make = (name, attributes, parent, text) => {
    const node = document.createElementNS(NS, name);
    Object.entries(attributes).forEach(([key, value]) => node.setAttribute(key, value));
    if (text !== undefined) node.textContent = text;
    if (parent) parent.append(node);
    return node;
  };
  const plain = value => (Math.abs(value) >= 100 ? value.toFixed(0) : `${+value.toPrecision(3)}`);

  // Round values between two ends: of the form 1, 2 or 5 times a power of ten on a logarithmic axis.
  function ticks(low, high, logarithmic) {
    if (logarithmic) {
      const powers = Array.from({ length: Math.ceil(high) - Math.floor(low) + 1 }, (_, k) => 10 ** (Math.floor(low) + k));
      const all = powers.flatMap(power => [1, 2, 5].map(k => k * power)).filter(value => Math.log10(value) >= low && Math.log10(value) <= high);
      if (all.length < 2) return ticks(10 ** low, 10 ** high, false);
      return all.length > 5 ? all.filter(value => Math.log10(value) % 1 === 0) : all;
    }
    const power = 10 ** Math.floor(Math.log10(high - low)), step = [2, 1, 0.5].find(k => high - low >= 2 * k * power) * power;
    const first = Math.ceil(low / step);
    return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, k) => (first + k) * step);
  }

  // A parameter as its symbol, e.g. kv_se as k with the subscript v,se.
  function title(panel, svg) {
    const node = make("text", { x: 4, y: 14, class: "title" }, svg), match = panel.name.match(/^([A-Za-z])([A-Za-z]*)_([a-z]+)$/);
    if (match) {
      make("tspan", { class: "symbol" }, node, match[1]);
      make("tspan", { dy: 3, class: "index" }, node, [match[2], match[3]].filter(Boolean).join(","));
    } else node.textContent = panel.name;
    if (panel.unit) make("tspan", { dy: match ? -3 : 0 }, node, ` [${panel.unit}]`);
  }

  function chips(title, names) {
    const row = document.createElement("p");
    row.className = "chips";
    row.append(`${title}: `);
    names.forEach(name => {
      const chip = document.createElement("button");
      chip.type = "button";
      chip.textContent = name;
      chip.setAttribute("aria-pressed", "true");
      chip.addEventListener("click", () => {
        if (!off.delete(name)) off.add(name);
        chip.setAttribute("aria-pressed", String(!off.has(name)));
        draw();
      });
      row.append(chip, " ");
    });
    root.append(row);
  }

  chips("People", people);
  chips("Conditions", conditions);
  const said = document.createElement("p");
  said.className = "said-of-point";
  said.setAttribute("aria-live", "polite");
  const grid = document.createElement("div");
  grid.className = "panels";
  root.append(said, grid);

  const forget = () => root.querySelectorAll(".chosen").forEach(node => node.classList.remove("chosen"));

  function draw() {
    said.textContent = "Point at a value, or go through a panel with the arrow keys.";
    grid.replaceChildren(...panels.map(drawn));
  }

  function drawn(panel) {
    const places = panel.columns.map((column, k) => k).filter(k => !off.has(panel.columns[k][0]));
    const shown = panel.points.filter(point => !off.has(point[0]) && places.includes(point[1]));
    const svg = make("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, tabindex: 0, role: "img", "aria-label": `${panel.name}: ${shown.length} values` });
    title(panel, svg);
    if (!shown.length) return svg;
    const map = panel.logarithmic ? Math.log10 : value => value, values = shown.map(point => map(point[2]));
    let low = Math.min(...values), high = Math.max(...values);
    const margin = 0.08 * (high - low) || 0.1 * Math.abs(high) || 1;
    [low, high] = [!panel.logarithmic && low >= 0 ? Math.max(low - margin, 0) : low - margin, high + margin];
    const y = value => BOX.bottom - (Math.min(Math.max(map(value), low), high) - low) / (high - low) * (BOX.bottom - BOX.top);
    const x = column => BOX.left + (places.indexOf(column) + 0.5) / places.length * (BOX.right - BOX.left);
    ticks(low, high, panel.logarithmic).forEach(value => {
      make("line", { x1: BOX.left, x2: BOX.right, y1: y(value), y2: y(value), class: "grid" }, svg);
      make("text", { x: BOX.left - 4, y: y(value) + 4, "text-anchor": "end" }, svg, plain(value));
    });
    places.forEach(column => {
      const [condition, , level] = panel.columns[column];
      [condition, level].forEach((part, line) => make("text", { x: x(column), y: BOX.bottom + 14 + 12 * line, "text-anchor": "middle", class: places.length > 6 ? "narrow" : "" }, svg, part));
    });
    people.filter(name => !off.has(name)).forEach(name => {
      ["PT", "RT"].forEach(task => {
        const mine = shown.filter(point => point[0] === name && panel.columns[point[1]][1] === task);
        if (mine.length > 1) make("polyline", { points: mine.map(point => `${x(point[1])},${y(point[2])}`).join(" "), class: `line ${task}`, "data-person": name }, svg);
      });
    });
    const dots = [...shown].sort((a, b) => places.indexOf(a[1]) - places.indexOf(b[1]) || a[2] - b[2]).map(([name, column, value, lower, upper]) => {
      const [condition, task, level] = panel.columns[column];
      if (lower !== null && upper !== null) make("line", { x1: x(column), x2: x(column), y1: y(lower), y2: y(upper), class: `line ${task}`, "data-person": name }, svg);
      const interval = lower !== null && upper !== null ? `, 95 % interval ${plain(lower)} to ${plain(upper)}` : "";
      const text = `${name} in ${condition}${level ? `, level ${level}` : ""}: ${panel.name} ${plain(value)}${!panel.unit ? "" : ` ${panel.unit}`}${interval}`;
      const dot = make("circle", { cx: x(column), cy: y(value), r: 4, class: `dot ${task}`, "data-person": name }, svg);
      make("title", {}, dot, text);
      const tell = () => {
        said.textContent = text;
        root.querySelectorAll("[data-person]").forEach(node => node.classList.toggle("chosen", node.dataset.person === name));
      };
      dot.addEventListener("pointerenter", tell);
      dot.addEventListener("pointerleave", forget);
      return tell;
    });
    let at = -1;
    svg.addEventListener("keydown", event => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      at = Math.min(Math.max(at + step, 0), dots.length - 1);
      dots[at]();
    });
    svg.addEventListener("blur", forget);
    return svg;
  }

  draw();
})();
