// Draws a meshing pair with its controls. `told` is called with the time (ms) that is shown.
function rootsoptPair(told) {
  const at = id => document.getElementById(id);
  const element = (name, attributes, parent) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    parent.append(made);
    return made;
  };
  const svg = at("pair"), slider = at("frame"), play = at("play"), speed = at("speed");
  let motion = null, rotor, parts, longest, count = 1;

  // Shows a motion of a rotor; `jump`: from its greatest force on, otherwise at the same frame.
  function show(given, taken, jump) {
    if (JSON.stringify(given) !== JSON.stringify(rotor)) build(rotor = given);
    motion = taken;
    count = motion.rotation.length;
    longest = motion.forces ? Math.max(1e-30, ...motion.forces.flat()) : 1;
    slider.max = count - 1;
    if (jump) {
      const total = motion.forces ? motion.forces[0].map((force, k) => force + motion.forces[1][k]) : [0];
      slider.value = total.indexOf(Math.max(...total));
    }
    const idle = motion.forces && longest <= 1e-30;
    at("meaning").textContent = idle ? "No flank carries force at any instant." : motion.forces
      ? "A dot marks a contact that carries force, an arrow the force on rotor 2. Its length shows "
        + "the greatest force around that instant; the longest is " + longest.toPrecision(4)
        + " N. Contacts are drawn where they are in perfect rolling: penetrations are micrometres."
      : "Perfect rolling: no motion was simulated. Dots mark where the flanks touch, arrows the "
        + "direction of the force on rotor 2.";
    draw();
  }

  function build() {
    svg.replaceChildren();
    const edge = 1.05 * rotor.outer;
    svg.setAttribute("viewBox", [-edge, -edge, rotor.center + 2 * edge, 2 * edge].join(" "));
    const path = "M" + rotor.outline.map(([x, y]) => x + " " + -y).join("L") + "Z";
    const hole = rotor.bore / 2;
    const bore = rotor.bore
      ? `M${hole} 0A${hole} ${hole} 0 1 0 ${-hole} 0A${hole} ${hole} 0 1 0 ${hole} 0Z` : "";
    parts = {};
    for (const [name, x] of [["one", 0], ["two", rotor.center]]) {
      parts[name] = element("path", { d: path + bore, class: "rotor " + name }, svg);
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
    if (motion === null) return;
    const k = Math.min(Number(slider.value), count - 1), first = motion.rotation[k];
    const lag = motion.relative ? motion.relative[k] * 1e-3 * 180 / Math.PI : 0;
    parts.one.setAttribute("transform", `rotate(${-first})`);
    parts.two.setAttribute("transform",
      `translate(${rotor.center}) scale(-1 1) rotate(${-(first + lag + 180 / rotor.lobes)})`);
    parts.flanks.forEach((flank, side) => {
      const contact = motion.contacts[side];
      const share = motion.forces ? motion.forces[side][k] / longest : Number(contact.present[k]);
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
    const words = [`rotation ${(first - motion.rotation[0]).toFixed(1)}°`];
    if (motion.time) words.push(`time ${motion.time[k].toFixed(3)} ms`);
    if (motion.forces) {
      words.push(`drive flank ${motion.forces[0][k].toPrecision(4)} N`);
      words.push(`coast flank ${motion.forces[1][k].toPrecision(4)} N`);
      words.push(`relative rotation ${motion.relative[k].toPrecision(4)} mrad`);
    } else words.push("perfect rolling");
    at("pose").textContent = words.join(" · ");
    slider.setAttribute("aria-valuetext", words.join(", "));
    if (motion.time) told(motion.time[k]);
  }

  // Shows the frame nearest to a time (ms).
  function seek(time) {
    if (motion === null || !motion.time) return;
    const away = motion.time.map(one => Math.abs(one - time));
    slider.value = away.indexOf(Math.min(...away));
    draw();
  }

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
  slider.oninput = draw;
  play.onclick = () => {
    if (running === null) running = requestAnimationFrame(step);
    else { cancelAnimationFrame(running); running = null; }
    play.textContent = running === null ? "Play" : "Pause";
    play.setAttribute("aria-pressed", String(running !== null));
  };
  return { show, seek };
}
