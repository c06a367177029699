// Sorts tables of the class "sortable" by the first number of each cell; names, and cells without a number, by their text.
document.addEventListener("DOMContentLoaded", () => {
  const number = (cell) => Number(cell.textContent.replace(/(\d),(?=\d{3})/g, "$1").match(/-?\d*\.?\d+(e-?\d+)?/)?.[0] ?? NaN);
  const compare = (a, b, column) => {
    const [first, second] = [a.cells[column], b.cells[column]];
    const difference = column ? number(first) - number(second) : NaN;
    return Number.isNaN(difference) ? first.textContent.localeCompare(second.textContent) : difference;
  };
  for (const head of document.querySelectorAll("table.sortable th")) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.setAttribute("aria-label", `Sort by ${button.textContent.trim() || "name"}`);
    button.addEventListener("click", () => {
      const order = head.getAttribute("aria-sort") === "ascending" ? "descending" : "ascending";
      head.parentNode.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", order);
      const body = head.closest("table").tBodies[0];
      const rows = [...body.rows].sort((a, b) => compare(a, b, head.cellIndex));
      body.append(...(order === "ascending" ? rows : rows.reverse()));
    });
  }
});
