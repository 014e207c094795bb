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

  function draw() {
    said.textContent = "Point at a value.";
    grid.replaceChildren(...panels.map(drawn));
  }

  function drawn(panel) {
    const places = panel.columns.map((column, k) => k).filter(k => !off.has(panel.columns[k][0]));
    const shown = panel.points.filter(point => !off.has(point[0]) && places.includes(point[1]));
    const svg = make("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${panel.name}: ${shown.length} values` });
    make("text", { x: 4, y: 14, class: "title" }, svg, `${panel.name}${!panel.unit ? "" : ` [${panel.unit}]`}`);
    if (!shown.length) return svg;
    const map = panel.logarithmic ? Math.log10 : value => value, values = shown.map(point => map(point[2]));
    let low = Math.min(...values), high = Math.max(...values);
    const margin = 0.08 * (high - low) || 0.1 * Math.abs(high) || 1;
    [low, high] = [low - margin, high + margin];
    const y = value => BOX.bottom - (Math.min(Math.max(map(value), low), high) - low) / (high - low) * (BOX.bottom - BOX.top);
    const x = column => BOX.left + (places.indexOf(column) + 0.5) / places.length * (BOX.right - BOX.left);
    for (let k = 0; k <= 3; k += 1) {
      const at = low + k / 3 * (high - low), value = panel.logarithmic ? 10 ** at : at, place = BOX.bottom - k / 3 * (BOX.bottom - BOX.top);
      make("line", { x1: BOX.left, x2: BOX.right, y1: place, y2: place, class: "grid" }, svg);
      make("text", { x: BOX.left - 4, y: place + 4, "text-anchor": "end" }, svg, plain(value));
    }
    places.forEach(column => {
      const [condition, , level] = panel.columns[column];
      [condition, level].forEach((part, line) => make("text", { x: x(column), y: BOX.bottom + 14 + 12 * line, "text-anchor": "middle" }, svg, part));
    });
    people.filter(name => !off.has(name)).forEach(name => {
      ["PT", "RT"].forEach(task => {
        const mine = shown.filter(point => point[0] === name && panel.columns[point[1]][1] === task);
        if (mine.length > 1) make("polyline", { points: mine.map(point => `${x(point[1])},${y(point[2])}`).join(" "), class: `line ${task}`, "data-person": name }, svg);
      });
    });
    shown.forEach(([name, column, value, lower, upper]) => {
      const [condition, task, level] = panel.columns[column];
      if (lower !== null && upper !== null) make("line", { x1: x(column), x2: x(column), y1: y(lower), y2: y(upper), class: `line ${task}`, "data-person": name }, svg);
      const interval = lower !== null && upper !== null ? `, 95 % interval ${plain(lower)} to ${plain(upper)}` : "";
      const text = `${name} in ${condition}${level ? `, level ${level}` : ""}: ${panel.name} ${plain(value)}${!panel.unit ? "" : ` ${panel.unit}`}${interval}`;
      const dot = make("circle", { cx: x(column), cy: y(value), r: 4, class: `dot ${task}`, "data-person": name }, svg);
      make("title", {}, dot, text);
      dot.addEventListener("pointerenter", () => {
        said.textContent = text;
        root.querySelectorAll("[data-person]").forEach(node => node.classList.toggle("chosen", node.dataset.person === name));
      });
      dot.addEventListener("pointerleave", () => root.querySelectorAll(".chosen").forEach(node => node.classList.remove("chosen")));
    });
    return svg;
  }

  draw();
})();
