// Keeps slider and number field equal; the slider's span grows to hold a number outside of it.
const value = cb_obj.value;
if (value === null || !Number.isFinite(value)) { field.value = slider.value; return; }
window.rootsoptMoved = performance.now();
if (cb_obj === slider) {
  const rounded = Number(value.toPrecision(12));
  if (field.value !== rounded) field.value = rounded;
  return;
}
if (value > slider.end) slider.end = value;
if (value < slider.start) slider.start = value;
if (slider.value !== value) slider.value = value;
