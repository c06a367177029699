// Sort tables of the class "sortable": names by their text, other columns by the first number of a cell; without one, last.
document.addEventListener("DOMContentLoaded", () => {
  const number = (text) => Number(text.replace(/(\d),(?=\d{3})/g, "$1").match(/-?\d*\.?\d+(e-?\d+)?/)?.[0] ?? NaN);
  for (const head of document.querySelectorAll("table.sortable th")) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    button.setAttribute("aria-label", `Sort by ${button.textContent.trim() || "name"}`);
    head.append(button);
    button.addEventListener("click", () => {
      const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      const compare = (first, second) => {
        const texts = [first, second].map((row) => row.cells[head.cellIndex].textContent);
        const [x, y] = head.cellIndex ? texts.map(number) : [NaN, NaN];
        if (Number.isNaN(x) && Number.isNaN(y)) return sign * texts[0].localeCompare(texts[1]);
        return Number.isNaN(x) - Number.isNaN(y) || sign * (x - y);
      };
      head.parentNode.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      const body = head.closest("table").tBodies[0];
      body.append(...[...body.rows].sort(compare));
    });
  }
});
