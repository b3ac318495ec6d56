// Shows what the server says of the pair.
window.rootsoptView ??= rootsoptPair(time => { cursor.location = time; });
const told = data.text ? JSON.parse(data.text) : {};
document.querySelector(".pair").style.opacity = told.dim ? 0.3 : 1;
if (told.rotor && told.motion) {
  // The first motion with forces begins with the greatest one.
  const jump = !window.rootsoptJumped && told.motion.forces !== null;
  window.rootsoptJumped ||= jump;
  rootsoptView.show(told.rotor, told.motion, jump);
}
