// Plays a log over time, at a speed that can be chosen, again and again with a pause at its end.
// button: starts and stops; speed: input whose value is times real time; log: asked at each frame, with x and timestep;
// show(index): draws a sample; pause: samples at the end; stopped: called when it stops.
function playing({ button, speed, log, show, pause, stopped = () => {} }) {
  let timer = null, since = 0;

  function frame(now) {
    const { x, timestep } = log();
    show(Math.min(Math.floor((now - since) / 1e3 * parseFloat(speed.value) / timestep) % (x.length + pause), x.length - 1));
    timer = requestAnimationFrame(frame);
  }

  function play(on) {
    if (timer !== null) cancelAnimationFrame(timer);
    timer = null;
    button.textContent = on ? "Stop" : "Play";
    button.setAttribute("aria-pressed", on);
    since = performance.now();
    if (on) timer = requestAnimationFrame(frame);
    else stopped();
  }

  button.addEventListener("click", () => play(timer === null));
  return { play, isOn: () => timer !== null };
}
