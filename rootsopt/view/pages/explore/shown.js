// Says how long after the slider moved its numbers were drawn.
if (!mark.text) return;
const moved = window.rootsoptMoved;
if (moved === undefined) return;
window.rootsoptMoved = undefined;
requestAnimationFrame(() => requestAnimationFrame(() => {
  window.rootsoptDelay = performance.now() - moved;
  latency.text = `<span class="note">drawn ${Math.round(window.rootsoptDelay)} ms after the slider moved</span>`;
}));
