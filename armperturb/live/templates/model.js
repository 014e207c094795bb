"use strict";
// The arm of `analysis.arm.linear_arm` (closed form) and of `planar_arm` (simulation); units and symbols are theirs.
// An arm is the fields of `Subject` and `Environment` by name; `muscle` has those of `MuscleLaw`, three values each, and
// `shape`, the elastic limits of the parts over their mean, (element, part). Needs `eigenvalues`.
const ArmModel = (() => {
  // Of the samples of a movement, and its longest step [s]; into how many parts that is cut at most.
  const TIMESTEP = 2.5e-3, MOST_PARTS = 16;
  const RK4_LIMIT = 2.5;  // of the product of a pole's modulus and the step, as of `envs.lab.trial`
  const LEAP = 10;  // over the workspace limit, which within a step only an arm that diverges gets to
  const RADIAN = Math.PI / 180;

  const triple = (arm, name) => ["s", "se", "e"].map(place => arm[`${name}_${place}`]);
  // Joint matrix (s, se, e) to what the muscle groups (shoulder, two-joint, elbow) have of it (eq. 2.10).
  const groups = ([s, se, e]) => [s - se, se, e - se];

  // Inertia of the segments (a, b, c) of [[a + 2 c cos, b + c cos], [b + c cos, b]].
  function inertia(arm) {
    const forearm = arm.c_f * arm.l_f;
    const about = forearm ** 2 + (arm.r_f * arm.l_f) ** 2;
    const humerus = arm.m_h * ((arm.c_h * arm.l_h) ** 2 + (arm.r_h * arm.l_h) ** 2);
    return [humerus + arm.m_f * (arm.l_h ** 2 + about), arm.m_f * about, arm.m_f * arm.l_h * forearm];
  }

  // Columns of the Jacobian from joint angles to hand: those of shoulder (x, y) and elbow (x, y).
  function jacobian(arm) {
    const upper = arm.theta_s_deg * RADIAN, lower = upper + arm.theta_e_deg * RADIAN;
    const ex = -arm.l_f * Math.sin(lower), ey = arm.l_f * Math.cos(lower);
    return [ex - arm.l_h * Math.sin(upper), ey + arm.l_h * Math.cos(upper), ex, ey];
  }

  // Joint mass matrix (s, se, e) at the posture.
  function massMatrix(arm) {
    const [a, b, c] = inertia(arm), bend = c * Math.cos(arm.theta_e_deg * RADIAN);
    return [a + 2 * bend, b + bend, b];
  }

  // Endpoint admittance H from f to x [m/N] at a frequency [Hz]: (xx, xy, yx, yy), real and imaginary part in turn.
  function admittance(arm, frequency) {
    const w = 2 * Math.PI * frequency;
    const m = massMatrix(arm), b = triple(arm, "b"), k = triple(arm, "k"), kv = triple(arm, "kv"), kp = triple(arm, "kp");
    const re = [0, 0, 0, 0], im = [0, 0, 0, 0];
    for (let row = 0; row < 2; row += 1) {
      // Activation x delay of this joint: its real and imaginary part.
      const place = row ? "e" : "s", cut = 2 * Math.PI * arm[`fact_${place}`], delay = w * arm[`Td_${place}`];
      const below = [1 - (w / cut) ** 2, 2 * arm.zeta_act * w / cut], size = below[0] ** 2 + below[1] ** 2;
      const [cos, sin] = [Math.cos(delay), -Math.sin(delay)];
      const ar = (cos * below[0] + sin * below[1]) / size, ai = (sin * below[0] - cos * below[1]) / size;
      for (let column = 0; column < 2; column += 1) {
        const j = row + column, at = 2 * row + column;
        re[at] = k[j] - m[j] * w * w + ar * kp[j] - ai * w * kv[j];
        im[at] = w * b[j] + ar * w * kv[j] + ai * kp[j];
      }
    }
    const times = (i, j) => [re[i] * re[j] - im[i] * im[j], re[i] * im[j] + im[i] * re[j]];
    const [pr, pi] = times(0, 3), [qr, qi] = times(1, 2);
    const dr = pr - qr, di = pi - qi, size = dr * dr + di * di;
    // Inverse of the joint impedance.
    const zr = [], zi = [];
    [[3, 1], [1, -1], [2, -1], [0, 1]].forEach(([from, sign], at) => {
      zr[at] = sign * (re[from] * dr + im[from] * di) / size;
      zi[at] = sign * (im[from] * dr - re[from] * di) / size;
    });
    const [sx, sy, ex, ey] = jacobian(arm), left = [[sx, ex], [sy, ey]];
    const grip = arm.k_h ** 2 + (arm.b_h * w) ** 2, out = [];
    for (let i = 0; i < 2; i += 1) {
      for (let j = 0; j < 2; j += 1) {
        let r = 0, x = 0;
        for (let u = 0; u < 2; u += 1) {
          for (let v = 0; v < 2; v += 1) {
            const share = left[i][u] * left[j][v];
            r += share * zr[2 * u + v];
            x += share * zi[2 * u + v];
          }
        }
        if (i === j) {
          r += arm.k_h / grip;
          x -= arm.b_h * w / grip;
        }
        out.push(r, x);
      }
    }
    return out;
  }

  // Gain and unwrapped phase [degree] of the diagonal at frequencies: {gain: [x, y], phase: [x, y]}.
  function bode(arm, frequencies) {
    const gain = [[], []], phase = [[], []], last = [0, 0];
    for (const frequency of frequencies) {
      const h = admittance(arm, frequency);
      for (let axis = 0; axis < 2; axis += 1) {
        const r = h[6 * axis], i = h[6 * axis + 1];
        let angle = Math.atan2(i, r) / RADIAN;
        angle -= 360 * Math.round((angle - last[axis]) / 360);
        last[axis] = angle;
        gain[axis].push(Math.hypot(r, i));
        phase[axis].push(angle);
      }
    }
    return { gain, phase };
  }

  // Matrix of arm and load as one linear system with third-order Pade delays (appendix B), as rows. States: joint
  // velocities and angles, handle velocity and displacement, then of each reflexive joint the delay's three and the
  // activation's two.
  function dynamics(arm) {
    const [ms, mse, me] = massMatrix(arm), size = ms * me - mse * mse;
    const inverse = [[me / size, -mse / size], [-mse / size, ms / size]];
    const b = triple(arm, "b"), k = triple(arm, "k"), kv = triple(arm, "kv"), kp = triple(arm, "kp");
    const [sx, sy, ex, ey] = jacobian(arm), columns = [[sx, sy], [ex, ey]];
    const reflexive = [...kv, ...kp].some(gain => gain !== 0), n = reflexive ? 18 : 8;
    const a = Array.from({ length: n }, () => new Array(n).fill(0));
    const torque = [0, 1].map(() => new Array(n).fill(0)), force = [0, 1].map(() => new Array(n).fill(0));
    for (let axis = 0; axis < 2; axis += 1) {
      force[axis][4 + axis] = arm.b_h;
      force[axis][6 + axis] = arm.k_h;
      for (let joint = 0; joint < 2; joint += 1) {
        force[axis][joint] = -arm.b_h * columns[joint][axis];
        force[axis][2 + joint] = -arm.k_h * columns[joint][axis];
      }
    }
    for (let joint = 0; joint < 2; joint += 1) {
      for (let j = 0; j < n; j += 1) torque[joint][j] = columns[joint][0] * force[0][j] + columns[joint][1] * force[1][j];
      for (let other = 0; other < 2; other += 1) {
        torque[joint][other] -= b[joint + other];
        torque[joint][2 + other] -= k[joint + other];
      }
      if (!reflexive) continue;
      const place = joint ? "e" : "s", d = 8 + 5 * joint, t = arm[`Td_${place}`], cut = 2 * Math.PI * arm[`fact_${place}`];
      const c2 = 12 / t, c1 = 60 / t ** 2, c0 = 120 / t ** 3;
      a[d][d + 1] = a[d + 1][d + 2] = 1;
      [a[d + 2][d], a[d + 2][d + 1], a[d + 2][d + 2]] = [-c0, -c1, -c2];
      a[d + 3][d + 4] = 1;
      a[d + 4][d + 3] = -cut * cut;
      a[d + 4][d + 4] = -2 * arm.zeta_act * cut;
      a[d + 4][d] += cut * cut * 2 * c0;
      a[d + 4][d + 2] += cut * cut * 2 * c2;
      for (let other = 0; other < 2; other += 1) {
        a[d + 2][other] += kv[joint + other];
        a[d + 2][2 + other] += kp[joint + other];
        a[d + 4][other] -= cut * cut * kv[joint + other];
        a[d + 4][2 + other] -= cut * cut * kp[joint + other];
      }
      torque[joint][d + 3] -= 1;
    }
    for (let i = 0; i < 2; i += 1) {
      a[2 + i][i] = a[6 + i][4 + i] = 1;
      for (let j = 0; j < n; j += 1) {
        a[i][j] = inverse[i][0] * torque[0][j] + inverse[i][1] * torque[1][j];
        a[4 + i][j] = -force[i][j] / arm.m_env;
      }
      a[4 + i][4 + i] -= arm.b_env / arm.m_env;
      a[4 + i][6 + i] -= arm.k_env / arm.m_env;
    }
    return a;
  }

  // Linear arms between which a nonlinear one works: large movements, which have yielded, and small ones.
  function linearArms(arm) {
    if (!arm.muscle) return [arm];
    const [s, se, e] = arm.muscle.short_range_stiffness;
    const large = { ...arm, muscle: null };
    if (!(s + se + e)) return [large];
    return [large, { ...large, k_s: arm.k_s + s + se, k_se: arm.k_se + se, k_e: arm.k_e + e + se }];
  }

  // Largest real part of the poles of arm and load [1/s]; negative is stable.
  function largestRealPole(arm) {
    return Math.max(...linearArms(arm).map(each => {
      const poles = eigenvalues(dynamics(each));
      return poles ? Math.max(...poles.map(pole => pole[0])) : NaN;
    }));
  }

  // Largest modulus of the poles of arm and load without reflexes [1/s].
  function fastestPole(arm) {
    const still = Object.fromEntries(["kv", "kp"].flatMap(gain => ["s", "se", "e"].map(place => [`${gain}_${place}`, 0])));
    return Math.max(...linearArms(arm).flatMap(each => (eigenvalues(dynamics({ ...each, ...still })) || [[NaN, NaN]]).map(pole => Math.hypot(...pole))));
  }

  // Parts into which `TIMESTEP` is cut, a power of two: so that Runge-Kutta 4 is stable, and delays are three steps at least.
  function partsOf(arm) {
    const needed = Math.max(1, fastestPole(arm) * TIMESTEP / RK4_LIMIT, 3 * TIMESTEP / Math.min(arm.Td_s, arm.Td_e));
    return 2 ** Math.ceil(Math.log2(needed) - 1e-9);
  }

  // Numerator and denominator of the activation dynamics in discrete time (`controllers.lanes.activation_filter`).
  function activationFilter(cutoff, damping, timestep) {
    const w = 2 * Math.PI * cutoff * timestep, decay = Math.exp(-damping * w);
    const turn = damping < 1 ? Math.cos(w * Math.sqrt(1 - damping ** 2)) : Math.cosh(w * Math.sqrt(damping ** 2 - 1));
    const d = [1, -2 * decay * turn, decay * decay];
    const first = 2 * damping / w, second = 1 / w ** 2;
    const n0 = d[0] + d[1] + d[2];
    const n1 = -d[1] - 2 * d[2] - first * n0;
    const n2 = 0.5 * d[1] + 2 * d[2] - first * n1 - second * n0;
    const last = n2 + 0.5 * n1, middle = -n1 - 2 * last;
    return [[n0 - middle - last, middle, last], d];
  }

  function between(before, older, newer, after, t) {
    const first = 0.5 * (newer - before), last = 0.5 * (after - older), rise = newer - older;
    return older + t * (first + t * (3 * rise - 2 * first - last + t * (first + last - 2 * rise)));
  }

  // What was sent so many steps before the newest sample (`controllers.compiled.delayed`).
  function delayed(sent, newest, back) {
    const at = index => (index >= 0 ? sent[index] : 0);
    const whole = Math.floor(back + 1e-6), place = newest - whole;
    if (back - whole < 1e-6) return at(place);
    return between(at(place - 2), at(place - 1), at(place), at(place + 1), 1 - (back - whole));
  }

  // Movement from rest under a force on the handle, by Runge-Kutta 4 with torques of muscle law and reflexes as
  // `controllers.compiled.act` has them.
  //
  // force: [N] at the start and middle of each step, x and y in turn, 2 (2 n + 1) numbers.
  // timestep: `TIMESTEP`, or a whole part of it.
  // Returns x, y [m], shoulder and elbow angle [rad], force on the hand [N], each `TIMESTEP`, fewer where the movement
  // ends early; `ended` says why it does: at the "limit" of the workspace, or because it "diverged"; "" if it does not.
  function simulate(arm, force, timestep = TIMESTEP) {
    const n = (force.length / 2 - 1) / 2, every = Math.round(TIMESTEP / timestep), workspace = arm.workspace || 0.35;
    const b = triple(arm, "b"), k = triple(arm, "k"), kv = triple(arm, "kv"), kp = triple(arm, "kp");
    const law = arm.muscle, shortRange = law ? law.short_range_stiffness : [0, 0, 0];
    const spring = [k[0] + shortRange[0] + shortRange[1], k[1] + shortRange[1], k[2] + shortRange[2] + shortRange[1]];
    const dampingGroups = groups(b), kvGroups = groups(kv);
    const saturation = law ? law.spindle_saturation : [Infinity, Infinity, Infinity];
    const direction = law ? law.spindle_direction : [0, 0, 0];
    const threshold = law ? law.spindle_threshold : [0, 0, 0];
    const upper0 = arm.theta_s_deg * RADIAN, lower0 = upper0 + arm.theta_e_deg * RADIAN;
    const handX = arm.l_h * Math.cos(upper0) + arm.l_f * Math.cos(lower0);
    const handY = arm.l_h * Math.sin(upper0) + arm.l_f * Math.sin(lower0);
    const [ia, ib, ic] = inertia(arm);
    const reflexive = [...kv, ...kp].some(gain => gain !== 0);
    const filters = ["s", "e"].map(place => activationFilter(arm[`fact_${place}`], arm.zeta_act, timestep));
    const delay = [arm.Td_s / timestep, arm.Td_e / timestep];
    const states = [[0, 0], [0, 0]], sent = [new Float64Array(n), new Float64Array(n)];
    const bond = [], intact = [1, 1, 1], before = [0, 0, 0], limits = [];
    if (law) {
      for (let e = 0; e < 3; e += 1) {
        bond.push(new Float64Array(law.shape[e].length));
        limits.push(law.shape[e].map(part => part * Math.min(law.elastic_limit_deg[e] * RADIAN, 1e6)));
      }
    }
    const torque = new Float64Array(6);
    let wsBefore = 0, weBefore = 0;

    function slope(z, stage, step, out, grip) {
      const [qs, qe, x, y, ws, we, vx, vy] = z;
      const u = upper0 + qs, l = lower0 + qs + qe;
      const sinU = Math.sin(u), cosU = Math.cos(u), sinL = Math.sin(l), cosL = Math.cos(l);
      const ex = -arm.l_f * sinL, ey = arm.l_f * cosL, sx = ex - arm.l_h * sinU, sy = ey + arm.l_h * cosU;
      const fx = arm.k_h * (x + handX - sy) + arm.b_h * (vx - sx * ws - ex * we);
      const fy = arm.k_h * (y + handY + sx) + arm.b_h * (vy - sy * ws - ey * we);
      if (grip) { grip[0] = fx; grip[1] = fy; }
      const couple = ic * (cosU * cosL + sinU * sinL), swirl = ic * (cosU * sinL - sinU * cosL);
      const ts = torque[2 * stage] + sx * fx + sy * fy + swirl * we * (2 * ws + we)
        - (spring[0] * qs + spring[1] * qe + b[0] * ws + b[1] * we);
      const te = torque[2 * stage + 1] + ex * fx + ey * fy - swirl * ws * ws
        - (spring[1] * qs + spring[2] * qe + b[1] * ws + b[2] * we);
      const ms = ia + 2 * couple, mse = ib + couple, share = 1 / (ms * ib - mse * mse), at = 2 * (2 * step + stage);
      out[0] = ws; out[1] = we; out[2] = vx; out[3] = vy;
      out[4] = (ib * ts - mse * te) * share;
      out[5] = (ms * te - mse * ts) * share;
      out[6] = (force[at] - fx - arm.b_env * vx - arm.k_env * x) / arm.m_env;
      out[7] = (force[at + 1] - fy - arm.b_env * vy - arm.k_env * y) / arm.m_env;
    }

    function act(z, step) {
      const [qs, qe, , , ws, we] = z;
      torque.fill(0);
      if (law) {
        const stretch = [qs + 0.5 * timestep * ws, 0, qe + 0.5 * timestep * we];
        const velocity = [1.5 * ws - 0.5 * wsBefore, 0, 1.5 * we - 0.5 * weBefore];
        stretch[1] = stretch[0] + stretch[2];
        velocity[1] = velocity[0] + velocity[2];
        const taken = [0, 0, 0];
        for (let e = 0; e < 3; e += 1) {
          const move = stretch[e] - before[e], speed = Math.abs(velocity[e]);
          before[e] = stretch[e];
          const survival = 1 / (1 + Math.abs(move) / (law.loss_angle_deg[e] * RADIAN)), whole = intact[e] * survival;
          let total = 0;
          for (let part = 0; part < limits[e].length; part += 1) {
            const limit = whole * (limits[e][part] + law.shape[e][part] * law.elastic_limit_slope[e] * speed);
            bond[e][part] = Math.min(Math.max(bond[e][part] * survival + whole * move, -limit), limit);
            total += bond[e][part];
          }
          intact[e] = 1 - (1 - whole) * Math.exp(-timestep / law.recovery_time[e]);
          const thinned = speed / law.thinning_velocity[e];
          taken[e] = shortRange[e] * stretch[e] - total * shortRange[e] / limits[e].length
            + dampingGroups[e] * velocity[e] * (thinned / (1 + thinned));
        }
        for (let stage = 0; stage < 3; stage += 1) {
          torque[2 * stage] += taken[0] + taken[1];
          torque[2 * stage + 1] += taken[2] + taken[1];
        }
      }
      wsBefore = ws;
      weBefore = we;
      if (!reflexive) return;
      const excitation = [kv[0] * ws + kv[1] * we + kp[0] * qs + kp[1] * qe, kv[1] * ws + kv[2] * we + kp[1] * qs + kp[2] * qe];
      [ws, ws + we, we].forEach((velocity, e) => {
        const answered = speed => {
          const above = Math.max(speed, threshold[e]) - Math.max(threshold[e], 0);
          return above / (1 + Math.abs(above) / saturation[e]);
        };
        const seen = Math.min(1 + direction[e], 1) * answered(velocity) - Math.min(1 - direction[e], 1) * answered(-velocity);
        const missing = kvGroups[e] * (seen - velocity);
        if (e < 2) excitation[0] += missing;
        if (e > 0) excitation[1] += missing;
      });
      for (let joint = 0; joint < 2; joint += 1) {
        const [numerator, denominator] = filters[joint], state = states[joint];
        const active = numerator[0] * excitation[joint] + state[0];
        state[0] = numerator[1] * excitation[joint] - denominator[1] * active + state[1];
        state[1] = numerator[2] * excitation[joint] - denominator[2] * active;
        sent[joint][step] = active;
        for (let stage = 0; stage < 3; stage += 1) {
          torque[2 * stage + joint] -= delayed(sent[joint], step, delay[joint] - 0.5 * stage);
        }
      }
    }

    const log = { x: [0], y: [0], shoulder: [upper0], elbow: [lower0 - upper0], fx: [0], fy: [0], timestep: TIMESTEP, ended: "" };
    let z = new Array(8).fill(0);
    const k1 = new Array(8), k2 = new Array(8), k3 = new Array(8), k4 = new Array(8), there = new Array(8), grip = [0, 0];
    const half = 0.5 * timestep;
    for (let step = 0; step < n; step += 1) {
      act(z, step);
      slope(z, 0, step, k1, grip);
      if (step % every === 0) {
        log.fx[step / every] = grip[0];
        log.fy[step / every] = grip[1];
      }
      for (let i = 0; i < 8; i += 1) there[i] = z[i] + half * k1[i];
      slope(there, 1, step, k2);
      for (let i = 0; i < 8; i += 1) there[i] = z[i] + half * k2[i];
      slope(there, 1, step, k3);
      for (let i = 0; i < 8; i += 1) there[i] = z[i] + timestep * k3[i];
      slope(there, 2, step, k4);
      z = z.map((value, i) => value + timestep / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]));
      const farthest = Math.max(Math.abs(z[2]), Math.abs(z[3]));
      if (!(farthest < workspace)) {
        log.ended = farthest < LEAP * workspace ? "limit" : "diverged";
        break;
      }
      if ((step + 1) % every) continue;
      log.x.push(z[2]);
      log.y.push(z[3]);
      log.shoulder.push(upper0 + z[0]);
      log.elbow.push(lower0 - upper0 + z[1]);
      log.fx.push(grip[0]);
      log.fy.push(grip[1]);
    }
    return log;
  }

  // Movement under a force at the longest step that can integrate it.
  //
  // forceAt: from a step [s] to the force as `simulate` wants it.
  // Returns the arm, what `simulate` does as `log`, the force, and `parts` of `TIMESTEP` in a step. An arm that is too
  // fast for `MOST_PARTS` rests in a log that `ended` as "fast".
  function move(arm, forceAt) {
    let parts = partsOf(arm);
    if (!(parts <= MOST_PARTS)) return { arm, parts: 1, force: new Float64Array(2), log: { ...simulate(arm, new Float64Array(2)), ended: "fast" } };
    for (;; parts *= 2) {
      const force = forceAt(TIMESTEP / parts), log = simulate(arm, force, TIMESTEP / parts);
      if (log.ended !== "diverged" || 2 * parts > MOST_PARTS) return { arm, parts, force, log };
    }
  }

  // Puts into the middle of each step the cubic of the laboratory's motors through four samples, zero beyond the ends.
  function smoothed(force) {
    const at = i => force[i] ?? 0;
    for (let middle = 2; middle < force.length; middle += 4) {
      for (const i of [middle, middle + 1]) force[i] = (9 * (at(i - 2) + at(i + 2)) - (at(i - 6) + at(i + 6))) / 16;
    }
    return force;
  }

  // Half a sine of a peak [N] in a direction [degree], from an onset on [s], as `simulate` wants it.
  function pulse(peak, directionDeg, onset, duration, timestep = TIMESTEP, width = 0.08) {
    const n = Math.round(duration / timestep), force = new Float64Array(2 * (2 * n + 1));
    for (let half = 0; half <= 2 * n; half += 1) {
      const since = 0.5 * half * timestep - onset;
      if (since < 0 || since >= width) continue;
      const size = peak * Math.sin(Math.PI / width * since);
      force[2 * half] = size * Math.cos(directionDeg * RADIAN);
      force[2 * half + 1] = size * Math.sin(directionDeg * RADIAN);
    }
    return smoothed(force);
  }

  // A multisine of unit RMS from its lines [Hz], their amplitudes and phases, (axis, line), likewise.
  function multisine(frequencies, amplitudes, phases, duration, timestep = TIMESTEP) {
    const n = Math.round(duration / timestep), force = new Float64Array(2 * (2 * n + 1));
    phases.forEach((ofAxis, axis) => frequencies.forEach((frequency, line) => {
      // Turned on by the same angle from sample to sample.
      const step = Math.PI * frequency * timestep, c = Math.cos(step), s = Math.sin(step);
      let re = amplitudes[line] * Math.cos(ofAxis[line]), im = amplitudes[line] * Math.sin(ofAxis[line]);
      for (let half = 0; half <= 2 * n; half += 1) {
        force[2 * half + axis] += re;
        [re, im] = [re * c - im * s, re * s + im * c];
      }
    }));
    return smoothed(force);
  }

  return { TIMESTEP, MOST_PARTS, RK4_LIMIT, admittance, bode, dynamics, fastestPole, largestRealPole, linearArms, move, pulse, multisine };
})();
