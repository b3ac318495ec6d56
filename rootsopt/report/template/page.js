"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const at = id => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";
  const element = (name, attributes, parent) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    parent.append(made);
    return made;
  };

  // Charts
  const options = {
    responsive: true,
    displaylogo: false,
    modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
  };
  const cursor = x => [{
    type: "line", xref: "x", yref: "paper", x0: x, x1: x, y0: 0, y1: 1,
    line: { color: "#111", width: 1 },
  }];
  let timeline = null;
  data.charts.forEach((figure, number) => {
    const plot = at("chart-" + number);
    Plotly.newPlot(plot, figure.data, figure.layout, options);
    if (figure.cursor) timeline = plot;
  });
  const printed = window.matchMedia("print");
  const fit = narrow => {
    for (const plot of document.querySelectorAll(".plot"))
      Plotly.relayout(plot, narrow ? { width: 670, height: 300 } : { width: null, height: 360 });
  };
  window.addEventListener("beforeprint", () => fit(true));
  window.addEventListener("afterprint", () => fit(false));
  if (printed.matches) fit(true);

  // Config
  at("save").onclick = () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([at("yaml").textContent], { type: "application/yaml" }));
    link.download = "config.yaml";
    link.click();
    URL.revokeObjectURL(link.href);
  };

  // Meshing
  if (!data.animation) return;
  const { rotors, cases } = data.animation;
  const svg = at("pair"), slider = at("frame"), play = at("play"), speed = at("speed");
  let shown, parts, longest, count;

  function choose(number) {
    shown = cases[number];
    count = shown.rotation.length;
    longest = shown.forces ? Math.max(1e-30, ...shown.forces.flat()) : 1;
    slider.max = count - 1;
    const total = shown.forces ? shown.forces[0].map((force, k) => force + shown.forces[1][k]) : [0];
    slider.value = total.indexOf(Math.max(...total));
    build(rotors[shown.rotor]);
    const idle = shown.forces && longest <= 1e-30;
    at("meaning").textContent = idle ? "No flank carries force at any instant." : shown.forces
      ? "A dot marks a contact that carries force, an arrow the force on rotor 2. Its length shows "
        + "the greatest force around that instant; the longest is " + longest.toPrecision(4)
        + " N. Contacts are drawn where they are in perfect rolling: penetrations are micrometres."
      : "Perfect rolling: no motion was simulated. Dots mark where the flanks touch, arrows the "
        + "direction of the force on rotor 2.";
    draw();
  }

  function build(rotor) {
    svg.replaceChildren();
    const edge = 1.05 * rotor.outer;
    svg.setAttribute("viewBox", [-edge, -edge, rotor.center + 2 * edge, 2 * edge].join(" "));
    const hole = rotor.bore / 2;
    const bore = rotor.bore
      ? `M${hole} 0A${hole} ${hole} 0 1 0 ${-hole} 0A${hole} ${hole} 0 1 0 ${hole} 0Z` : "";
    parts = { rotor };
    for (const [name, x] of [["one", 0], ["two", rotor.center]]) {
      parts[name] = element("path", { d: rotor.path + bore, class: "rotor " + name }, svg);
      element("circle", { cx: x, cy: 0, r: rotor.pitch, class: "pitch" }, svg);
      element("circle", { cx: x, cy: 0, r: 0.012 * rotor.outer, fill: "#111" }, svg);
      const text = element("text", {
        x, y: rotor.outer * 0.16 + hole, "text-anchor": "middle", "font-size": rotor.outer * 0.085,
      }, svg);
      text.textContent = name === "one" ? "rotor 1" : "rotor 2";
    }
    parts.flanks = ["drive", "coast"].map(name => ({
      dot: element("circle", { r: 0.028 * rotor.outer, class: "contact " + name }, svg),
      shaft: element("line", { class: name, "stroke-width": 0.018 * rotor.outer }, svg),
      head: element("path", { class: name, "stroke-width": 0 }, svg),
    }));
  }

  function draw() {
    const k = Number(slider.value), rotor = parts.rotor;
    const first = shown.rotation[k];
    const lag = shown.relative ? shown.relative[k] * 1e-3 * 180 / Math.PI : 0;
    parts.one.setAttribute("transform", `rotate(${-first})`);
    parts.two.setAttribute("transform",
      `translate(${rotor.center}) scale(-1 1) rotate(${-(first + lag + 180 / rotor.lobes)})`);
    parts.flanks.forEach((flank, side) => {
      const contact = shown.contacts[side];
      const share = shown.forces ? shown.forces[side][k] / longest : Number(contact.present[k]);
      const x = contact.x[k], y = -contact.y[k], nx = contact.nx[k], ny = -contact.ny[k];
      const visible = share > 0 ? "visible" : "hidden";
      for (const part of Object.values(flank)) part.setAttribute("visibility", visible);
      flank.dot.setAttribute("cx", x);
      flank.dot.setAttribute("cy", y);
      const tip = 0.09 * rotor.outer, long = Math.max(0.75 * rotor.pitch * share, tip);
      const ex = x + nx * long, ey = y + ny * long, bx = ex - nx * tip, by = ey - ny * tip;
      flank.shaft.setAttribute("x1", x);
      flank.shaft.setAttribute("y1", y);
      flank.shaft.setAttribute("x2", bx);
      flank.shaft.setAttribute("y2", by);
      flank.head.setAttribute("d", `M${ex} ${ey}L${bx - 0.45 * tip * ny} ${by + 0.45 * tip * nx}`
        + `L${bx + 0.45 * tip * ny} ${by - 0.45 * tip * nx}Z`);
    });
    const turn = first - shown.rotation[0];
    const words = [`rotation ${turn.toFixed(1)}°`];
    if (shown.time) words.push(`time ${shown.time[k].toFixed(3)} ms`);
    if (shown.forces) {
      words.push(`drive flank ${shown.forces[0][k].toPrecision(4)} N`);
      words.push(`coast flank ${shown.forces[1][k].toPrecision(4)} N`);
      words.push(`relative rotation ${shown.relative[k].toPrecision(4)} mrad`);
    }
    at("pose").textContent = words.join(" · ");
    slider.setAttribute("aria-valuetext", words.join(", "));
    if (timeline && shown.time) Plotly.relayout(timeline, { shapes: cursor(shown.time[k]) });
  }

  slider.oninput = draw;
  if (at("case")) at("case").onchange = event => choose(Number(event.target.value));
  if (timeline) timeline.on("plotly_click", event => {
    if (!shown.time) return;
    const x = event.points[0].x;
    const away = shown.time.map(time => Math.abs(time - x));
    slider.value = away.indexOf(Math.min(...away));
    draw();
  });
  let running = null, before = 0;
  function step(now) {
    if (running === null) return;
    if (now - before > 500 / Number(speed.value) ** 1.5) {
      before = now;
      slider.value = (Number(slider.value) + 1) % count;
      draw();
    }
    running = requestAnimationFrame(step);
  }
  play.onclick = () => {
    if (running === null) running = requestAnimationFrame(step);
    else { cancelAnimationFrame(running); running = null; }
    play.textContent = running === null ? "Play" : "Pause";
    play.setAttribute("aria-pressed", String(running !== null));
  };
  choose(cases.length - 1 && cases[1].name === "optimised" ? 1 : 0);
  if (at("case")) at("case").value = String(cases.indexOf(shown));
})();
