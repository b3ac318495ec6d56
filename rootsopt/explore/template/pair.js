// Draws both rotors at the rotation of the slider, and the forces on rotor 2.
const at = Math.round(turn.value);
const rotation = poses.data.rotation, count = rotation.length;
if (!count || !outline.data.x.length) {
  for (const source of [one, two, drive, coast]) source.data = { x: [], y: [], ex: [], ey: [] };
  return;
}
const k = Math.min(at, count - 1);
const { center, lobes, pitch, longest } = facts.data;
const place = (angle, mirror) => {
  const c = Math.cos(angle), s = Math.sin(angle), x = outline.data.x, y = outline.data.y;
  const px = new Float64Array(x.length), py = new Float64Array(x.length);
  for (let i = 0; i < x.length; i++) {
    const u = c * x[i] - s * y[i];
    px[i] = mirror ? center[0] - u : u;
    py[i] = s * x[i] + c * y[i];
  }
  return { x: px, y: py };
};
one.data = place(rotation[k], false);
two.data = place(rotation[k] + poses.data.relative[k] + Math.PI / lobes[0], true);
const arrow = (name, source) => {
  const d = poses.data, force = d[name + "_force"][k], known = longest[0] > 0;
  const share = known ? force / longest[0] : Number(d[name + "_present"][k]);
  if (!(share > 0)) { source.data = { x: [], y: [], ex: [], ey: [] }; return; }
  const x = d[name + "_x"][k], y = d[name + "_y"][k];
  const long = pitch[0] * Math.max(0.12, 0.75 * share);
  source.data = { x: [x], y: [y], ex: [x + long * d[name + "_nx"][k]], ey: [y + long * d[name + "_ny"][k]] };
};
arrow("drive", drive);
arrow("coast", coast);
const degrees = (rotation[k] - rotation[0]) * 180 / Math.PI;
const words = [`rotor 1 at ${degrees.toFixed(1)}°`];
if (longest[0] > 0) {
  words.push(`drive flank ${poses.data.drive_force[k].toPrecision(4)} N`);
  words.push(`coast flank ${poses.data.coast_force[k].toPrecision(4)} N`);
  cursor.location = poses.data.time[k];
} else {
  words.push("perfect rolling");
}
pose.text = words.join(" · ");
