// Drawings on a canvas that pages share: curves with axes, and an arm from above.
const Drawing = (() => {
  const COLOURS = { BLUE: "#0072b2", RED: "#d55e00", GREY: "#6b7480", INK: "#262a30", LINE: "#e6e8eb" };
  const { BLUE, RED, GREY, INK, LINE } = COLOURS;

  function context(canvas) {
    const ratio = window.devicePixelRatio || 1, { width, height } = canvas.getBoundingClientRect();
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    c.font = "12px system-ui, sans-serif";
    return [c, width, height];
  }

  const plain = number => (Math.abs(number) >= 100 ? number.toFixed(0) : `${+number.toPrecision(2)}`);

  function ticksOf(low, high, log) {
    if (log) {
      const ticks = [];
      for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
        (high / low > 200 ? [1] : [1, 2, 5]).forEach(lead => ticks.push(lead * 10 ** power));
      }
      return ticks.filter(tick => tick >= low * 0.999 && tick <= high * 1.001);
    }
    const rough = (high - low) / 5, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map(lead => lead * power).find(each => each >= rough);
    const ticks = [];
    for (let tick = Math.ceil(low / step) * step; tick <= high + 1e-9; tick += step) ticks.push(Math.abs(tick) < 1e-12 ? 0 : tick);
    return ticks;
  }

  function plot(canvas, { series, x, y, title, xLabel, legend, xTicks, yTicks }) {
    const [c, width, height] = context(canvas);
    const box = { left: 46, right: width - 10, top: 24, bottom: height - (xLabel ? 34 : 20) };
    const scale = (range, from, to) => {
      const map = range.log ? Math.log10 : v => v;
      const [low, high] = [map(range.low), map(range.high)];
      return v => from + (map(v) - low) / (high - low) * (to - from);
    };
    const px = scale(x, box.left, box.right), py = scale(y, box.bottom, box.top);
    c.strokeStyle = LINE;
    c.fillStyle = INK;
    c.lineWidth = 1;
    (xTicks || ticksOf(x.low, x.high, x.log)).forEach(tick => {
      c.beginPath();
      c.moveTo(px(tick), box.top);
      c.lineTo(px(tick), box.bottom);
      c.stroke();
      c.textAlign = "center";
      c.fillText(plain(tick), px(tick), box.bottom + 14);
    });
    (yTicks || ticksOf(y.low, y.high, y.log)).forEach(tick => {
      c.beginPath();
      c.moveTo(box.left, py(tick));
      c.lineTo(box.right, py(tick));
      c.stroke();
      c.textAlign = "right";
      c.fillText(plain(tick), box.left - 5, py(tick) + 4);
    });
    c.textAlign = "left";
    c.fillText(title, 6, 15);
    let place = width - 8;
    c.textAlign = "right";
    [...(legend || [])].reverse().forEach(([text, colour]) => {
      c.fillStyle = colour;
      c.fillText(text, place, 15);
      place -= c.measureText(text).width + 12;
    });
    c.fillStyle = INK;
    if (xLabel) {
      c.textAlign = "center";
      c.fillText(xLabel, 0.5 * (box.left + box.right), height - 5);
    }
    c.save();
    c.beginPath();
    c.rect(box.left, box.top - 4, box.right - box.left, box.bottom - box.top + 8);
    c.clip();
    series.forEach(each => {
      c.strokeStyle = each.colour;
      c.lineWidth = each.width || 2;
      c.setLineDash(each.dash || []);
      c.beginPath();
      each.y.forEach((v, i) => (i ? c.lineTo(px(each.x[i]), py(v)) : c.moveTo(px(each.x[i]), py(v))));
      c.stroke();
    });
    c.restore();
    return { px, box, c };
  }

  // The path once more, enlarged, at the upper left, where no arm comes.
  function path(c, width, index, movement, reference) {
    const size = Math.min(0.36 * width, 150), left = 8, top = 8;
    const reach = 1.15 * Math.max(...[movement.log, reference.log].flatMap(log => log.x.map((x, i) => Math.max(Math.abs(x), Math.abs(log.y[i])))), 1e-4);
    const bar = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1].filter(each => each <= reach).pop() || 0.001;
    c.fillStyle = "#fff";
    c.strokeStyle = LINE;
    c.lineWidth = 1;
    c.fillRect(left, top, size, size);
    c.strokeRect(left, top, size, size);
    const scale = size / (2 * reach), x0 = left + 0.5 * size, y0 = top + 0.5 * size;
    [[reference.log, GREY, 1.2, [5, 4]], [movement.log, BLUE, 2, []]].forEach(([log, colour, lineWidth, dash], which) => {
      if (!which && reference.log === movement.log) return;
      const n = Math.min(index, log.x.length - 1);
      c.strokeStyle = colour;
      c.lineWidth = lineWidth;
      c.setLineDash(dash);
      c.beginPath();
      for (let i = 0; i <= n; i += 1) c.lineTo(x0 + scale * log.x[i], y0 - scale * log.y[i]);
      c.stroke();
      c.setLineDash([]);
      c.fillStyle = colour;
      c.beginPath();
      c.arc(x0 + scale * log.x[n], y0 - scale * log.y[n], which ? 4 : 2.5, 0, 7);
      c.fill();
    });
    c.fillStyle = INK;
    c.textAlign = "left";
    c.fillRect(left + 6, top + size - 7, bar * scale, 2);
    c.fillText(`${1000 * bar} mm`, left + 6, top + size - 11);
  }

  // The arm from above with the force and the path so far, and beside it, dashed, what else it might have done.
  // A movement has arm: lengths l_h and l_f; log: timestep, x, y, shoulder, elbow; forceAt: index to x and y; largest: of the forces.
  function arm(canvas, movement, reference, index, words) {
    const [c, width, height] = context(canvas);
    const { l_h, l_f } = movement.arm, scale = Math.min(width / 0.95, height / 0.85), originX = 0.36 * width, originY = height - 0.12 * scale;
    const to = ([x, y]) => [originX + x * scale, originY - y * scale];
    const joints = (shoulder, elbow) => {
      const e = [l_h * Math.cos(shoulder), l_h * Math.sin(shoulder)];
      return [[0, 0], e, [e[0] + l_f * Math.cos(shoulder + elbow), e[1] + l_f * Math.sin(shoulder + elbow)]];
    };
    const draw = (points, colour, lineWidth, dash) => {
      c.strokeStyle = colour;
      c.lineWidth = lineWidth;
      c.setLineDash(dash || []);
      c.lineJoin = c.lineCap = "round";
      c.beginPath();
      points.forEach((point, i) => (i ? c.lineTo(...to(point)) : c.moveTo(...to(point))));
      c.stroke();
      c.setLineDash([]);
    };
    const log = movement.log, rest = joints(log.shoulder[0], log.elbow[0]), handle = [rest[2][0] - log.x[0], rest[2][1] - log.y[0]];
    c.fillStyle = "#eef1f4";
    c.beginPath();
    c.ellipse(...to([-0.16, -0.02]), 0.2 * scale, 0.09 * scale, 0, 0, 7);
    c.fill();
    draw(rest, "#d3d8de", 10, []);
    draw(joints(log.shoulder[index], log.elbow[index]), "#8b929c", 10);
    const pathTo = k => Array.from({ length: k + 1 }, (_, i) => [handle[0] + movement.log.x[i], handle[1] + movement.log.y[i]]);
    if (reference.log !== log) {
      const n = Math.min(index, reference.log.x.length - 1);
      draw(Array.from({ length: n + 1 }, (_, i) => [handle[0] + reference.log.x[i], handle[1] + reference.log.y[i]]), GREY, 1.4, [5, 4]);
    }
    draw(pathTo(index), BLUE, 2.2);
    const now = [handle[0] + log.x[index], handle[1] + log.y[index]];
    c.fillStyle = INK;
    c.beginPath();
    c.arc(...to(now), 7, 0, 7);
    c.fill();
    const [fx, fy] = movement.forceAt(index), size = Math.hypot(fx, fy);
    if (size > 0.02 * movement.largest) {
      const reach = 0.22 / movement.largest, tip = [now[0] + fx * reach, now[1] + fy * reach];
      draw([now, tip], RED, 4);
      const angle = Math.atan2(fy, fx);
      draw([[tip[0] - 0.03 * Math.cos(angle - 0.5), tip[1] - 0.03 * Math.sin(angle - 0.5)], tip, [tip[0] - 0.03 * Math.cos(angle + 0.5), tip[1] - 0.03 * Math.sin(angle + 0.5)]], RED, 4);
    }
    path(c, width, index, movement, reference);
    c.fillStyle = INK;
    c.textAlign = "right";
    c.fillText(`${((movement.from || 0) + index * log.timestep).toFixed(2)} s`, width - 8, 16);
    words.forEach(([word, colour], line) => {
      c.fillStyle = colour;
      c.fillText(word, width - 8, 32 + 16 * line);
    });
    c.fillStyle = INK;
    c.textAlign = "left";
    c.fillText("10 cm", 8, height - 16);
    c.fillRect(8, height - 10, 0.1 * scale, 2);
  }

  return { COLOURS, plain, plot, arm };
})();
