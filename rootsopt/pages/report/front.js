const points = data.points;
const path = outline => "M" + outline.map(([x, y]) => x + " " + -y).join("L") + "Z";
const rows = [...document.querySelectorAll("tbody tr")]
  .filter(row => row.firstElementChild.textContent in points);
let chosen = null;
function choose(number) {
  const point = points[number], before = chosen && points[chosen];
  at("name").textContent =
    "Point " + number + (chosen && chosen !== number ? " (dashed: point " + chosen + ")" : "");
  at("status").textContent = point.status;
  at("yaml").textContent = point.yaml;
  const size = 1.05 * Math.max(...Object.values(points).flatMap(one =>
    one.outline.map(p => Math.hypot(p[0], p[1]))));
  at("outline").setAttribute("viewBox", [-size, -size, 2 * size, 2 * size].join(" "));
  at("outline").innerHTML = '<path d="' + path(point.outline) + '"/>' +
    (before && before !== point ? '<path class="other" d="' + path(before.outline) + '"/>' : "");
  for (const row of rows)
    row.classList.toggle("chosen", row.firstElementChild.textContent === number);
  at("save").disabled = false;
  at("save").onclick = () => rootsoptSave(point.yaml, point.file);
  chosen = number;
}
// Chooses the point nearest to a click, if it is close.
rootsoptCharts().then(documents => {
  for (const plot of documents.map(one => one.roots()[0])) {
    const [across, up] = plot.name.split(" ");
    const reach = range => range.end - range.start;
    plot.on_event("tap", event => {
      const away = Object.entries(points).map(([number, one]) => [number, Math.hypot(
        (one.terms[across] - event.x) / reach(plot.x_range),
        (one.terms[up] - event.y) / reach(plot.y_range))]);
      const [number, least] = away.sort((a, b) => a[1] - b[1])[0];
      if (least < 0.03) choose(number);
    });
  }
});
for (const row of rows) {
  const number = row.firstElementChild.textContent;
  row.dataset.point = number;
  row.tabIndex = 0;
  row.onclick = () => choose(number);
  row.onkeydown = event => { if (event.key === "Enter") choose(number); };
}
