// Draws the charts of a page, and returns a promise of their documents.
const at = id => document.getElementById(id);
const data = JSON.parse(at("data").textContent);
function rootsoptCharts() {
  if (!data.charts.length) return Promise.resolve([]);
  const drawn = Promise.all(data.charts.map(one => Bokeh.embed.embed_item(one)))
    .then(() => Bokeh.documents);
  drawn.then(documents => {
    const fit = narrow => {
      for (const plot of documents.map(one => one.roots()[0])) {
        plot.sizing_mode = narrow ? "fixed" : "stretch_width";
        plot.width = narrow ? 670 : null;
      }
    };
    window.addEventListener("beforeprint", () => fit(true));
    window.addEventListener("afterprint", () => fit(false));
    if (window.matchMedia("print").matches) fit(true);
  });
  return drawn;
}
function rootsoptSave(text, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/yaml" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}
