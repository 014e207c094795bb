const Lab = (() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const { BLUE, RED, GREY } = Drawing.COLOURS, { plain, plot } = Drawing;
  const MIN_FREQUENCY = 0.15, MAX_FREQUENCY = 45, DURATION = { pulse: 1.2, multisine: 8 }, ONSET = 0.1;
  const frequencies = Array.from({ length: 120 }, (_, i) => MIN_FREQUENCY * (MAX_FREQUENCY / MIN_FREQUENCY) ** (i / 119));
  // The multisine of 1 N at each step that it was wanted for [s].
  const units = {}, { frequencies: tones, amplitudes, phases } = data.multisine;
  const unit = timestep => (units[timestep] ??= ArmModel.multisine(tones, amplitudes, phases, DURATION.multisine, timestep));
  const at = id => document.getElementById(id);

  // Name, label, unit, least, most, whether logarithmic; `of` gives the chosen person's value, else 1 is a factor.
  const SLIDERS = {
    "Muscle": [
      { name: "level", label: "co-contraction", unit: "×", min: 0.25, max: 4, log: true },
      { name: "k", label: "stiffness", unit: "×", min: 0.25, max: 4, log: true },
      { name: "b", label: "damping", unit: "×", min: 0.25, max: 4, log: true },
    ],
    "Reflexes": [
      { name: "kv", label: "velocity feedback", unit: "×", min: 0, max: 3 },
      { name: "kp", label: "position feedback", unit: "×", min: 0, max: 3 },
      { name: "delay", label: "delay", unit: "ms", min: 10, max: 100, of: arm => 1e3 * arm.Td_s },
      { name: "cutoff", label: "cut-off of activation", unit: "Hz", min: 1, max: 10, of: arm => arm.fact_s },
    ],
    "Muscle law": [
      { name: "law", label: "short-range stiffness (0: linear muscle)", unit: "×", min: 0, max: 3 },
      { name: "limit", label: "elastic limit", unit: "×", min: 0.25, max: 4, log: true },
      { name: "thin", label: "speed that halves damping", unit: "×", min: 0.25, max: 4, log: true },
    ],
    "Load": [
      { name: "mass", label: "mass", unit: "kg", min: 0.5, max: 12, of: () => data.load.m_env },
      { name: "damper", label: "damper", unit: "Ns/m", min: 0, max: 60, of: () => data.load.b_env },
      { name: "spring", label: "spring", unit: "N/m", min: 0, max: 500, of: () => data.load.k_env },
    ],
    "Posture": [
      { name: "shoulder", label: "shoulder", unit: "°", min: 0, max: 80, of: arm => arm.theta_s_deg },
      { name: "elbow", label: "elbow", unit: "°", min: 20, max: 140, of: arm => arm.theta_e_deg },
    ],
    "Force": [
      { name: "peak", label: "peak of the pulse", unit: "N", min: 1, max: 150, of: arm => (arm.task === "PT" ? 54 : 18) },
      { name: "direction", label: "direction of the pulse", unit: "°", min: 0, max: 360, of: () => 20 },
      { name: "rms", label: "RMS of the multisine", unit: "N", min: 0.2, max: 20, of: arm => (arm.task === "PT" ? 5 : 1) },
    ],
  };
  const ALL = Object.values(SLIDERS).flat();
  const state = { preset: Object.keys(data.presets)[0], kind: "pulse", values: {} };

  const person = () => data.presets[state.preset];
  const standard = slider => (slider.of ? slider.of(person()) : slider.name === "law" && !person().muscle ? 0 : 1);
  const value = name => state.values[name] ?? standard(ALL.find(slider => slider.name === name));
  const reflexive = () => ["kv", "kp"].some(gain => ["s", "se", "e"].some(place => person()[`${gain}_${place}`] !== 0));
  const infinite = values => values.map(each => (each === null ? Infinity : each));

  // The arm of the person with every slider where it is, or as the person was chosen.
  function armOf(get) {
    const arm = { ...person() };
    const scale = (quantity, factor) => ["s", "se", "e"].forEach(place => { arm[`${quantity}_${place}`] *= factor; });
    const level = get("level");
    scale("k", level * get("k"));
    scale("b", level * get("b"));
    scale("kv", level * get("kv"));
    scale("kp", level * get("kp"));
    // Places whose values differ keep their ratio.
    const ratio = (a, b) => (a ? b / a : 1);
    arm.Td_e = 1e-3 * get("delay") * ratio(person().Td_s, person().Td_e);
    arm.Td_s = 1e-3 * get("delay");
    arm.fact_e = get("cutoff") * ratio(person().fact_s, person().fact_e);
    arm.fact_s = get("cutoff");
    if (arm.muscle && get("law") > 0) {
      const law = { ...arm.muscle };
      ["elastic_limit_deg", "loss_angle_deg", "recovery_time", "thinning_velocity", "spindle_saturation"].forEach(name => { law[name] = infinite(law[name]); });
      law.short_range_stiffness = law.short_range_stiffness.map(each => each * level * get("law"));
      law.spindle_threshold = law.spindle_threshold.map((each, e) => each + law.spindle_threshold_slope[e] * (level - 1));
      law.elastic_limit_deg = law.elastic_limit_deg.map(each => each * get("limit"));
      law.thinning_velocity = law.thinning_velocity.map(each => each * get("thin"));
      arm.muscle = law;
    } else {
      arm.muscle = null;
    }
    Object.assign(arm, { m_env: get("mass"), b_env: get("damper"), k_env: get("spring"), workspace: data.load.workspace });
    Object.assign(arm, { theta_s_deg: get("shoulder"), theta_e_deg: get("elbow") });
    return arm;
  }
  const chosen = () => armOf(name => standard(ALL.find(slider => slider.name === name)));

  // From a step [s] to the force at it.
  const forceOf = get => timestep => {
    if (state.kind === "pulse") return ArmModel.pulse(get("peak"), get("direction"), ONSET, DURATION.pulse, timestep);
    const rms = get("rms");
    return unit(timestep).map(each => each * rms);
  };

  // What moves now, and what the person as chosen would do under the same force (`unchanged`).
  let movement = null, reference = null, cursor = 0;
  const unchanged = {};

  const drawArm = index => Drawing.arm(at("arm"), movement, reference, index, [["force", RED], ["path of the handle", BLUE]]);

  function drawCurves() {
    const arms = ArmModel.linearArms(movement.arm), now = ArmModel.bode(arms[0], frequencies), before = unchanged.curves;
    const stiff = arms[1] && ArmModel.bode(arms[1], frequencies), mm = values => values.map(each => 1e3 * each);
    const x = { low: MIN_FREQUENCY, high: MAX_FREQUENCY, log: true }, xTicks = [0.2, 0.5, 1, 2, 5, 10, 20, 40];
    const lines = (key, map) => [
      ...before[key].map(y => ({ x: frequencies, y: map(y), colour: GREY, width: 1.2, dash: [5, 4] })),
      ...(stiff ? stiff[key].map((y, i) => ({ x: frequencies, y: map(y), colour: [BLUE, RED][i], width: 0.8 })) : []),
      ...now[key].map((y, i) => ({ x: frequencies, y: map(y), colour: [BLUE, RED][i] })),
    ];
    const gains = lines("gain", mm), every = gains.flatMap(each => each.y);
    const legend = [["x", BLUE], ["y", RED]];
    plot(at("gain"), {
      series: gains, x, xTicks, title: "gain of the admittance [mm/N]", legend,
      y: { low: 10 ** Math.floor(Math.log10(Math.min(...every))), high: 10 ** Math.ceil(Math.log10(Math.max(...every))), log: true },
    });
    const phases = lines("phase", values => values), angles = phases.flatMap(each => each.y);
    const lowest = 90 * Math.floor(Math.min(...angles, -180) / 90), highest = 90 * Math.ceil(Math.max(...angles, 0) / 90);
    const turn = [45, 90, 180, 360].find(each => (highest - lowest) / each <= 6) || 720;
    plot(at("phase"), {
      series: phases, x, xTicks, title: "phase, unwrapped [°]", xLabel: "frequency [Hz]", legend,
      y: { low: lowest, high: highest },
      yTicks: Array.from({ length: 2 * Math.ceil(1440 / turn) + 1 }, (_, i) => turn * (i - Math.ceil(1440 / turn))).filter(tick => tick >= lowest && tick <= highest),
    });
    return now;
  }

  function drawCourse() {
    const time = log => log.x.map((_, i) => i * log.timestep), cm = values => values.map(each => 100 * each);
    const series = [];
    if (reference.log !== movement.log) {
      [reference.log.x, reference.log.y].forEach(y => series.push({ x: time(reference.log), y: cm(y), colour: GREY, width: 1.2, dash: [5, 4] }));
    }
    [movement.log.x, movement.log.y].forEach((y, i) => series.push({ x: time(movement.log), y: cm(y), colour: [BLUE, RED][i] }));
    const every = series.flatMap(each => each.y), low = Math.min(...every, -0.1), high = Math.max(...every, 0.1), margin = 0.06 * (high - low);
    plot(at("course"), {
      series, x: { low: 0, high: DURATION[state.kind] }, y: { low: low - margin, high: high + margin },
      title: "displacement of the handle [cm]", xLabel: "time [s]", legend: [["x", BLUE], ["y", RED]],
    });
  }

  // What is said of a movement that ends early.
  const ENDS = {
    limit: () => ["handle", "reaches the limit of the workspace", true],
    diverged: () => ["movement", `cannot be computed: it grows beyond all bounds in steps of ${plain(1e3 * ArmModel.TIMESTEP / ArmModel.MOST_PARTS)} ms (expected less force, or weaker feedback)`, true],
    fast: arm => {
      const most = ArmModel.RK4_LIMIT * ArmModel.MOST_PARTS / ArmModel.TIMESTEP;
      return ["movement", `not computed: fastest pole of arm and load = ${plain(ArmModel.fastestPole(arm))} 1/s; expected at most ${plain(most)} 1/s (less damping or stiffness, or more mass)`, true];
    },
  };

  function tell(curves) {
    const arm = movement.arm, pole = ArmModel.largestRealPole(arm), log = movement.log;
    const distance = log.x.map((x, i) => 100 * Math.hypot(x, log.y[i]));
    const low = curves.gain.map(each => 1e3 * each[0]);
    const rms = Math.sqrt(log.x.reduce((sum, x, i) => sum + x * x + log.y[i] ** 2, 0) / (2 * log.x.length));
    const rows = [
      ["gain at 0.15 Hz, x and y", `${plain(low[0])} and ${plain(low[1])} mm/N`],
      ["stability margin", pole < 0 ? `${plain(-pole)} 1/s` : `unstable, ${plain(pole)} 1/s`, pole >= 0],
      ...(log.ended ? [ENDS[log.ended](arm)] : []),
      ...(log.ended === "fast" || log.ended === "diverged" ? [] : [state.kind === "pulse" ? ["largest distance", `${plain(Math.max(...distance))} cm`] : ["RMS displacement per axis", `${plain(1e3 * rms)} mm`]]),
    ];
    at("numbers").replaceChildren(...rows.flatMap(([name, text, bad]) => {
      const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
      dt.textContent = name;
      dd.textContent = text;
      if (bad) dd.className = "bad";
      return [dt, dd];
    }));
    at("gain").setAttribute("aria-label", `Gain of the admittance over frequency; at 0.15 Hz ${rows[0][1]}`);
    at("course").setAttribute("aria-label", `Displacement of the handle over time after a ${state.kind}; ${rows[rows.length - 1].slice(0, 2).join(" ")}`);
  }

  // ---- settings
  function hash() {
    const parts = { preset: state.preset, ...(state.kind === "pulse" ? {} : { kind: state.kind }), ...state.values };
    return `#${new URLSearchParams(parts)}`;
  }

  function readHash() {
    const parts = new URLSearchParams(location.hash.slice(1));
    const asked = parts.get("preset");
    if (asked !== null && Object.hasOwn(data.presets, asked)) state.preset = asked;
    at("absent").hidden = asked === null || asked === state.preset;
    at("absent").textContent = `This page has no ${asked}: what the link sets is set to ${state.preset}.`;
    state.kind = parts.get("kind") === "multisine" ? "multisine" : "pulse";
    state.values = {};
    ALL.forEach(slider => {
      const given = parseFloat(parts.get(slider.name));
      if (Number.isFinite(given)) state.values[slider.name] = Math.min(Math.max(given, slider.min), slider.max);
    });
  }

  const position = (slider, v) => (slider.log ? Math.log(v / slider.min) / Math.log(slider.max / slider.min) : (v - slider.min) / (slider.max - slider.min));
  const valueAt = (slider, share) => +(slider.log ? slider.min * (slider.max / slider.min) ** share : slider.min + share * (slider.max - slider.min)).toPrecision(3);

  function showSettings() {
    at("preset").value = state.preset;
    at("kind").value = state.kind;
    ALL.forEach(slider => {
      const input = at(`s-${slider.name}`), v = value(slider.name);
      input.value = position(slider, v);
      input.setAttribute("aria-valuetext", `${plain(v)} ${slider.unit}`);
      at(`o-${slider.name}`).textContent = `${plain(v)} ${slider.unit}`;
      // Without a muscle law, or without reflexes, there is nothing to turn.
      input.disabled = SLIDERS["Muscle law"].includes(slider) ? !person().muscle : SLIDERS.Reflexes.includes(slider) && !reflexive();
    });
    at("link").href = hash();
  }

  function redraw() {
    const began = performance.now();
    const moved = arm => {
      const { force, parts, log } = ArmModel.move(arm, forceOf(value));
      const largest = force.reduce((most, _, i) => (i % 2 ? most : Math.max(most, Math.hypot(force[i], force[i + 1]))), 1e-9);
      return { arm, log, largest, forceAt: index => [force[4 * parts * index], force[4 * parts * index + 1]] };
    };
    const changed = Object.keys(state.values).length > 0;
    movement = moved(armOf(value));
    const key = [state.preset, state.kind, ...["peak", "direction", "rms"].map(value)].join(" ");
    if (unchanged.key !== key) {
      const arm = chosen();
      Object.assign(unchanged, { key, movement: moved(arm), curves: ArmModel.bode({ ...arm, muscle: null }, frequencies) });
    }
    reference = changed ? unchanged.movement : movement;
    showSettings();
    tell(drawCurves());
    drawCourse();
    if (!player.isOn()) cursor = movement.log.x.length - 1;
    drawArm(Math.min(cursor, movement.log.x.length - 1));
    api.took = performance.now() - began;
  }

  function changed() {
    history.replaceState(null, "", hash());
    redraw();
  }

  // ---- playing
  const show = index => { cursor = index; drawArm(index); };
  const player = playing({ button: at("play"), speed: at("speed"), log: () => movement.log, show, pause: 200, stopped: redraw });

  const api = { state, redraw, armOf: () => armOf(value), took: 0 };

  Object.keys(data.presets).forEach(name => at("preset").append(new Option(name, name)));
  Object.entries(SLIDERS).forEach(([title, sliders]) => {
    const group = document.createElement("fieldset"), legend = document.createElement("legend");
    legend.textContent = title;
    group.append(legend);
    sliders.forEach(slider => {
      const row = document.createElement("div"), label = document.createElement("label");
      const output = document.createElement("output"), input = document.createElement("input");
      row.className = "slider";
      label.htmlFor = input.id = `s-${slider.name}`;
      output.id = `o-${slider.name}`;
      output.htmlFor = input.id;
      label.textContent = slider.label;
      Object.assign(input, { type: "range", min: 0, max: 1, step: "any" });
      input.addEventListener("input", () => {
        state.values[slider.name] = valueAt(slider, parseFloat(input.value));
        changed();
      });
      row.append(label, output, input);
      group.append(row);
    });
    at(["Load", "Posture", "Force"].includes(title) ? "outside" : "sliders").append(group);
  });
  at("preset").addEventListener("change", event => { state.preset = event.target.value; changed(); });
  at("kind").addEventListener("change", event => { state.kind = event.target.value; changed(); });
  at("reset").addEventListener("click", () => { state.values = {}; changed(); });
  addEventListener("hashchange", () => { readHash(); redraw(); });
  addEventListener("resize", redraw);
  readHash();
  redraw();
  return api;
})();
