"use strict";
(function () {
  const at = name => document.getElementById(`played-${name}`);
  if (!at("arm")) return;
  const people = JSON.parse(at("data").textContent);
  const { BLUE, RED, GREY } = Drawing.COLOURS, METRE = 1e-4, NEWTON = 0.1;
  let movement = null, prediction = null, cursor = 0;

  // Angles of shoulder and elbow with the hand at a place; the elbow bends as at the start.
  function angles({ l_h, l_f, posture }, [x, y]) {
    const cosine = (x * x + y * y - l_h * l_h - l_f * l_f) / (2 * l_h * l_f);
    const elbow = Math.acos(Math.min(Math.max(cosine, -1), 1)) * (Math.sin(posture[1]) < 0 ? -1 : 1);
    return [Math.atan2(y, x) - Math.atan2(l_f * Math.sin(elbow), l_h + l_f * Math.cos(elbow)), elbow];
  }

  // Displacements in metres, and the posture of the arm with its hand there.
  function logOf(person, trial, numbers) {
    const [s, e] = person.posture;
    const start = [person.l_h * Math.cos(s) + person.l_f * Math.cos(s + e), person.l_h * Math.sin(s) + person.l_f * Math.sin(s + e)];
    const [x, y] = numbers.map(axis => axis.map(each => METRE * each));
    const poses = x.map((_, i) => angles(person, [start[0] + x[i], start[1] + y[i]]));
    return { x, y, shoulder: poses.map(pose => pose[0]), elbow: poses.map(pose => pose[1]), timestep: 1 / trial.rate };
  }

  const farthest = (log, lead) => 100 * Math.max(...log.x.map((x, i) => (i < lead ? 0 : Math.hypot(x, log.y[i]))));

  function choose() {
    const person = people[at("person").selectedIndex], trial = person.trials[at("trial").selectedIndex];
    const [fx, fy] = trial.force.map(axis => axis.map(each => NEWTON * each));
    movement = {
      arm: person, log: logOf(person, trial, trial.recorded), forceAt: index => [fx[index], fy[index]],
      largest: Math.max(...fx.map((x, i) => Math.hypot(x, fy[i])), 1e-9), from: -trial.lead / trial.rate,
    };
    prediction = trial.predicted[0].length ? { log: logOf(person, trial, trial.predicted) } : movement;
    const recorded = farthest(movement.log, trial.lead), predicted = farthest(prediction.log, trial.lead);
    at("said").textContent = `${person.name}, ${trial.condition}, trial ${trial.trial + 1}: at most ${recorded.toFixed(1)} cm from the start of the trial${prediction === movement ? "" : `; ${predicted.toFixed(1)} cm predicted (recorded / predicted ${(recorded / predicted).toFixed(2)})`}.`;
    at("course").setAttribute("aria-label", `Displacement of the handle over time. ${at("said").textContent}`);
    at("arm").setAttribute("aria-label", `The arm from above. ${at("said").textContent}`);
    show(movement.log.x.length - 1);
  }

  function list() {
    const chosen = at("trial").selectedIndex, { trials } = people[at("person").selectedIndex];
    at("trial").replaceChildren(...trials.map(trial => new Option(`${trial.condition} ×${trial.level}, ${trial.direction}°`)));
    const predicted = trials.findIndex(trial => trial.predicted[0].length);
    at("trial").selectedIndex = chosen >= 0 && chosen < trials.length ? chosen : Math.max(predicted, 0);
    choose();
  }

  function show(index) {
    cursor = index;
    at("time").value = index / (movement.log.x.length - 1);
    Drawing.arm(at("arm"), movement, prediction, index, [["force", RED], ["path, recorded", BLUE], ...(prediction === movement ? [] : [["path, predicted", GREY]])]);
    const time = movement.log.x.map((_, i) => movement.from + i * movement.log.timestep), cm = values => values.map(each => 100 * each);
    const series = [[prediction.log, [5, 4], 1.4], [movement.log, [], 2.2]].filter(([log], k) => k || log !== movement.log).flatMap(
      ([log, dash, width]) => [[log.x, BLUE], [log.y, RED]].map(([values, colour]) => ({ x: time, y: cm(values), colour, dash, width })));
    const every = series.flatMap(each => each.y), low = Math.min(...every, -0.1), high = Math.max(...every, 0.1), margin = 0.06 * (high - low);
    const range = { low: low - margin, high: high + margin };
    series.push({ x: [time[index], time[index]], y: [range.low, range.high], colour: GREY, width: 1 });
    Drawing.plot(at("course"), {
      series, x: { low: time[0], high: time[time.length - 1] }, y: range,
      title: "displacement [cm]", xLabel: "time after the onset [s]", legend: [["x", BLUE], ["y", RED]],
    });
  }

  const player = playing({ button: at("play"), speed: at("speed"), log: () => movement.log, show, pause: 20 });

  at("person").addEventListener("change", list);
  at("trial").addEventListener("change", choose);
  at("time").addEventListener("input", () => {
    const wanted = parseFloat(at("time").value);
    player.play(false);
    show(Math.round(wanted * (movement.log.x.length - 1)));
  });
  addEventListener("resize", () => show(cursor));
  list();
})();
