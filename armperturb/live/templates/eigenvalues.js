// Eigenvalues of a real matrix, [real, imaginary] each: balanced, brought to Hessenberg form, then by the QR algorithm
// with Wilkinson's shifts in complex numbers.
function eigenvalues(matrix) {
  const n = matrix.length, a = matrix.map(row => [...row]);
  for (let changed = true; changed;) {
    changed = false;
    for (let i = 0; i < n; i += 1) {
      let row = 0, column = 0;
      for (let j = 0; j < n; j += 1) if (j !== i) { row += Math.abs(a[i][j]); column += Math.abs(a[j][i]); }
      if (!row || !column) continue;
      const factor = 2 ** Math.round(0.5 * Math.log2(row / column));
      if (factor === 1) continue;
      changed = true;
      for (let j = 0; j < n; j += 1) { a[i][j] /= factor; }
      for (let j = 0; j < n; j += 1) { a[j][i] *= factor; }
    }
  }
  for (let k = 1; k < n - 1; k += 1) {
    let pivot = k;
    for (let i = k + 1; i < n; i += 1) if (Math.abs(a[i][k - 1]) > Math.abs(a[pivot][k - 1])) pivot = i;
    if (a[pivot][k - 1] === 0) continue;
    [a[k], a[pivot]] = [a[pivot], a[k]];
    for (const row of a) [row[k], row[pivot]] = [row[pivot], row[k]];
    for (let i = k + 1; i < n; i += 1) {
      const share = a[i][k - 1] / a[k][k - 1];
      if (share === 0) continue;
      for (let j = k - 1; j < n; j += 1) a[i][j] -= share * a[k][j];
      for (const row of a) row[k] += share * row[i];
    }
  }
  const re = a.map((row, i) => row.map((value, j) => (i > j + 1 ? 0 : value)));
  const im = a.map(row => row.map(() => 0));
  const root = (x, y) => {
    const size = Math.hypot(x, y), r = Math.sqrt(0.5 * (size + Math.abs(x)));
    if (r === 0) return [0, 0];
    return x >= 0 ? [r, y / (2 * r)] : [Math.abs(y) / (2 * r), y < 0 ? -r : r];
  };
  const eigenvalues = [];
  let last = n - 1, tries = 0;
  while (last >= 0) {
    let low = last;
    while (low > 0) {
      const near = Math.hypot(re[low][low], im[low][low]) + Math.hypot(re[low - 1][low - 1], im[low - 1][low - 1]);
      if (Math.hypot(re[low][low - 1], im[low][low - 1]) < 1e-15 * (near || 1)) break;
      low -= 1;
    }
    if (low === last) {
      eigenvalues.push([re[last][last], im[last][last]]);
      last -= 1;
      tries = 0;
      continue;
    }
    tries += 1;
    if (tries > 60) return null;
    // The eigenvalue of the last two rows that is nearer to the last entry.
    const [ar, ai, dr, di] = [re[last - 1][last - 1], im[last - 1][last - 1], re[last][last], im[last][last]];
    const [br, bi, cr, ci] = [re[last - 1][last], im[last - 1][last], re[last][last - 1], im[last][last - 1]];
    const hr = 0.5 * (ar - dr), hi = 0.5 * (ai - di);
    let [sr, si] = root(hr * hr - hi * hi + br * cr - bi * ci, 2 * hr * hi + br * ci + bi * cr);
    if (hr * sr + hi * si > 0) [sr, si] = [-sr, -si];
    let shiftR = dr + hr + sr, shiftI = di + hi + si;
    if (tries % 11 === 10) shiftR += Math.hypot(cr, ci);
    for (let i = low; i <= last; i += 1) { re[i][i] -= shiftR; im[i][i] -= shiftI; }
    const turns = [];
    for (let k = low; k < last; k += 1) {
      const [xr, xi, yr, yi] = [re[k][k], im[k][k], re[k + 1][k], im[k + 1][k]];
      const size = Math.hypot(xr, xi, yr, yi) || 1, c = [xr / size, xi / size], s = [yr / size, yi / size];
      turns.push([c, s]);
      for (let j = k; j <= last; j += 1) {
        const [ur, ui, vr, vi] = [re[k][j], im[k][j], re[k + 1][j], im[k + 1][j]];
        re[k][j] = c[0] * ur + c[1] * ui + s[0] * vr + s[1] * vi;
        im[k][j] = c[0] * ui - c[1] * ur + s[0] * vi - s[1] * vr;
        re[k + 1][j] = c[0] * vr - c[1] * vi - s[0] * ur + s[1] * ui;
        im[k + 1][j] = c[0] * vi + c[1] * vr - s[0] * ui - s[1] * ur;
      }
    }
    turns.forEach(([c, s], number) => {
      const k = low + number;
      for (let i = low; i <= Math.min(k + 1, last); i += 1) {
        const [ur, ui, vr, vi] = [re[i][k], im[i][k], re[i][k + 1], im[i][k + 1]];
        re[i][k] = ur * c[0] - ui * c[1] + vr * s[0] - vi * s[1];
        im[i][k] = ur * c[1] + ui * c[0] + vr * s[1] + vi * s[0];
        re[i][k + 1] = vr * c[0] + vi * c[1] - ur * s[0] - ui * s[1];
        im[i][k + 1] = vi * c[0] - vr * c[1] - ui * s[0] + ur * s[1];
      }
    });
    for (let i = low; i <= last; i += 1) { re[i][i] += shiftR; im[i][i] += shiftI; }
  }
  return eigenvalues;
}
