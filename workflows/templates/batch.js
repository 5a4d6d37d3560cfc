// Sorts the table of captures by a column, and says how two chosen captures are compared. Nothing is loaded.
(() => {
  const table = document.getElementById("captures"), body = table.tBodies[0];
  const written = [...body.rows];
  const ranks = { unusable: 0, usable: 1, good: 2, failed: 0, waiting: 1, submitted: 2, done: 4 };
  const heads = [...table.tHead.rows[0].cells];

  // What a cell is sorted by: a number, a rank, or text; null for an empty cell, which comes last in both directions.
  function valueOf(row, column, kind) {
    const text = row.cells[column].firstElementChild && kind === "text" ? row.cells[column].firstElementChild.textContent
      : row.cells[column].textContent.trim();
    if (!text) return null;
    if (kind === "number") return parseFloat(text.replaceAll(",", ""));
    return kind === "rank" ? ranks[text] ?? 3 : text;
  }

  function sort(head, column) {
    const before = head.getAttribute("aria-sort");
    const up = head.dataset.sort === "number" ? before === "descending" : before !== "ascending";
    const again = before === (head.dataset.sort === "number" ? "ascending" : "descending");
    heads.forEach((h) => h.removeAttribute("aria-sort"));
    if (again) return body.replaceChildren(...written); // the third click: as written
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const keyed = written.map((row) => [valueOf(row, column, head.dataset.sort), row]);
    const order = ([a], [b]) => a === null || b === null ? (a === null) - (b === null)
      : (up ? 1 : -1) * (typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b);
    body.replaceChildren(...keyed.sort(order).map(([, row]) => row));
  }

  heads.forEach((head, column) => {
    if (!head.dataset.sort) return;
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    button.addEventListener("click", () => sort(head, column));
    head.append(button);
  });

  // Two ticked captures: the command that compares them.
  const told = document.getElementById("compare"), chosen = [];
  const folder = decodeURI(location.pathname).replace(/\/batch\/[^/]*$/, "");
  const quoted = (name) => `'${`${folder}/${name}`.replaceAll("'", "'\\''")}'`;
  for (const row of written) {
    if (!row.dataset.name) continue;
    const tick = document.createElement("input");
    tick.type = "checkbox";
    tick.setAttribute("aria-label", `compare ${row.dataset.name}`);
    tick.addEventListener("change", () => {
      if (tick.checked) chosen.push([row.dataset.name, tick]);
      else chosen.splice(chosen.findIndex((c) => c[1] === tick), 1);
      if (chosen.length > 2) chosen.shift()[1].checked = false;
      told.textContent = chosen.length === 2 ? `neuface compare ${chosen.map((c) => quoted(c[0])).join(" ")}`
        : chosen.length ? "tick another capture to compare the two" : "";
      told.hidden = !chosen.length;
    });
    row.cells[0].append(tick);
  }
})();
