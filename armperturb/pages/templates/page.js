"use strict";
(function () {
  const all = (selector, root) => [...(root || document).querySelectorAll(selector)];

  // Escape closes an enlarged figure.
  document.addEventListener("keydown", event => {
    if (event.key === "Escape") all(".zoom input:checked").forEach(box => { box.checked = false; });
  });

  // A link into something closed opens it; paper shows everything.
  const openAround = node => {
    for (let at = node; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
  };
  const follow = () => {
    const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (target) { openAround(target); target.scrollIntoView(); }
  };
  addEventListener("hashchange", follow);
  follow();
  let closed = [];
  addEventListener("beforeprint", () => {
    closed = all("details:not([open])");
    closed.forEach(each => { each.open = true; });
  });
  addEventListener("afterprint", () => closed.forEach(each => { each.open = false; }));

  function save(name, type, content) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([content], { type }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  function button(label, title, action) {
    const made = document.createElement("button");
    made.type = "button";
    made.className = "get";
    made.textContent = label;
    made.setAttribute("aria-label", title);
    made.addEventListener("click", action);
    return made;
  }

  // Each figure as a vector file.
  all("figure[id^=figure-]").forEach(figure => {
    const name = figure.id.replace("figure-", "") + ".svg";
    const image = figure.querySelector("img");
    const caption = figure.querySelector("figcaption");
    if (!image || !caption || !image.src.startsWith("data:image/svg+xml;base64,")) return;
    caption.append(" ", button("SVG", "Download " + name, () => {
      const bytes = Uint8Array.from(atob(image.src.split(",")[1]), letter => letter.charCodeAt(0));
      save(name, "image/svg+xml", bytes);
    }));
  });

  // Each table as CSV, as it is shown; sorted by a click on the head of a column.
  const text = cell => cell.innerText.replace(/\s+/g, " ").trim().replace(/\u2212/g, "-");
  const number = cell => {
    const match = text(cell).match(/^[<≈]?\s*([+-]?\d*\.?\d+)/);
    return match ? parseFloat(match[1]) : NaN;
  };

  // Rows as a grid in which a cell stands in every place that it spans.
  function grid(rows) {
    const places = rows.map(() => []);
    rows.forEach((row, r) => [...row.cells].forEach(cell => {
      let c = 0;
      while (places[r][c]) c += 1;
      for (let i = 0; i < cell.rowSpan && r + i < rows.length; i += 1) {
        for (let j = 0; j < cell.colSpan; j += 1) places[r + i][c + j] = cell;
      }
    }));
    return places;
  }

  function csv(table) {
    const head = table.tHead ? grid([...table.tHead.rows]) : [];
    const names = head.length ? head[head.length - 1].map((_, c) =>
      [...new Set(head.map(row => row[c]))].map(cell => cell ? text(cell) : "").filter(Boolean).join(" ")) : [];
    const lines = [names, ...[...table.tBodies].flatMap(body => [...body.rows]).map(row => [...row.cells].map(text))];
    return lines.map(line => line.map(cell => /[",\n]/.test(cell) ? `"${cell.replace(/"/g, '""')}"` : cell).join(",")).join("\n") + "\n";
  }

  function sort(table, column, head) {
    const body = table.tBodies[0];
    const down = head.getAttribute("aria-sort") === "ascending";
    all("th[aria-sort]", table).forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const rows = [...body.rows].map((row, place) => ({ row, place, cell: row.cells[column] }));
    const compare = (a, b) => {
      const [x, y] = [number(a.cell), number(b.cell)];
      if (isNaN(x) !== isNaN(y)) return isNaN(x) ? 1 : -1;  // what has no number comes last, whichever the direction
      const order = isNaN(x) ? text(a.cell).localeCompare(text(b.cell), "en", { numeric: true }) : x - y;
      return (down ? -order : order) || a.place - b.place;
    };
    body.append(...rows.sort(compare).map(each => each.row));
  }

  all(".table table").forEach(table => {
    const box = table.closest(".table");
    const caption = box.previousElementSibling;
    const name = (box.id || "table").replace("table-", "") + ".csv";
    const get = button("CSV", "Download " + name, () => save(name, "text/csv", csv(table)));
    if (caption && caption.classList.contains("caption")) caption.append(" ", get);
    else box.before(get);
    if (!table.tHead || table.tBodies.length !== 1) return;
    const heads = grid([...table.tHead.rows]);
    heads[heads.length - 1].forEach((head, column) => {
      if (head.colSpan > 1 || head.querySelector("button") || !head.textContent.trim()) return;
      const clickable = document.createElement("button");
      clickable.type = "button";
      clickable.className = "sort";
      clickable.append(...head.childNodes);
      head.append(clickable);
      clickable.addEventListener("click", () => sort(table, column, head));
    });
  });

  // A table or figure that is wider or longer than its window says so.
  const look = () => all(".table, .frame").forEach(box => {
    box.classList.toggle("wide", box.scrollWidth > box.clientWidth + 1 && box.scrollLeft + box.clientWidth < box.scrollWidth - 1);
    box.classList.toggle("long", box.scrollHeight > box.clientHeight + 1 && box.scrollTop + box.clientHeight < box.scrollHeight - 1);
  });
  all(".table, .frame").forEach(box => box.addEventListener("scroll", look, { passive: true }));
  all("details").forEach(each => each.addEventListener("toggle", look));
  addEventListener("resize", look);
  look();
})();
