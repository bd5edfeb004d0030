// The image planes: keypoints and projections of the shown frame, where keypoints were used, and residuals.

const images = data.images;
const imageKeypoints = numbers(images.keypoints);
const imageResiduals = squares(images.residuals);
const statistics = data.cameras.map((camera) => ({
  density: shares(camera.density),
  means: numbers(camera.means),
  cloud: squares(camera.cloud),
  aside: squares(camera.aside),
}));

function drawImages(frame) {
  const mode = document.querySelector('input[name=mode]:checked').value;
  document.querySelectorAll('canvas.image').forEach((canvas) => drawImage(canvas, Number(canvas.dataset.camera), frame, mode));
}

/** The part of an image that is shown, in cells: all of it, or where keypoints were used. */
function part(camera) {
  const { columns, rows } = data.cameras[camera];
  const used = [...statistics[camera].density.keys()].filter((cell) => statistics[camera].density[cell] > 0);
  if (!shown('enlarge') || !used.length) return { left: 0, top: 0, wide: columns, tall: rows };
  const xs = used.map((cell) => cell % columns), ys = used.map((cell) => Math.floor(cell / columns));
  const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs) + 1, Math.min(...ys), Math.max(...ys) + 1];
  const share = Math.min(1, Math.max((right - left) / columns, (bottom - top) / rows));
  const [wide, tall] = [share * columns, share * rows];
  const inside = (first, last, size, all) => Math.max(0, Math.min(all - size, (first + last - size) / 2));
  return { left: inside(left, right, wide, columns), top: inside(top, bottom, tall, rows), wide, tall };
}

function drawImage(canvas, camera, frame, mode) {
  const sheet = cleared(canvas);
  if (!sheet) return;
  const { width: pixels, height: high, columns, rows } = data.cameras[camera];
  const { context, width, height } = sheet;
  const { left, top, wide, tall } = part(camera);
  const cellWide = width / wide, cellTall = height / tall;
  context.fillStyle = colour('used');
  statistics[camera].density.forEach((density, cell) => {
    if (!density) return;
    context.globalAlpha = 0.05 + 0.25 * density;
    context.fillRect(((cell % columns) - left) * cellWide, (Math.floor(cell / columns) - top) * cellTall, cellWide, cellTall);
  });
  context.globalAlpha = 1;
  if (mode === 'residuals') return drawMeans(context, camera, cellWide, cellTall, left, top);
  const place = (x, y) => [(x / pixels * columns - left) * cellWide, (y / high * rows - top) * cellTall];
  return drawKeypoints(context, camera, frame, place);
}

/** The mean residual of each cell as an arrow; arrows that agree with their neighbours tell of a wrong lens or clock. */
function drawMeans(context, camera, wide, tall, left, top) {
  const { columns } = data.cameras[camera];
  const { means } = statistics[camera];
  const longest = Math.max(...means.filter(Number.isFinite).map(Math.abs), 0.01);
  const factor = (0.9 * Math.min(wide, tall)) / longest;
  context.strokeStyle = colour('ink');
  context.lineWidth = 1.3;
  for (let cell = 0; 2 * cell < means.length; cell += 1) {
    const [x, y] = [means[2 * cell], means[2 * cell + 1]];
    if (!Number.isFinite(x)) continue;
    const from = [((cell % columns) + 0.5 - left) * wide, (Math.floor(cell / columns) + 0.5 - top) * tall];
    context.beginPath();
    context.moveTo(from[0], from[1]);
    context.lineTo(from[0] + factor * x, from[1] + factor * y);
    context.stroke();
    dot(context, from[0], from[1], 1.6, colour('ink'));
  }
  context.font = '11px system-ui, "DejaVu Sans", sans-serif';
  context.fillStyle = colour('soft');
  context.fillText(`longest side ${written(longest, 2)} px`, 6, 14);
}

function drawKeypoints(context, camera, frame, place) {
  const own = Math.min(images.count - 1, Math.round(frame / images.every));
  for (let point = 0; point < P; point += 1) {
    const start = 2 * ((camera * images.count + own) * P + point);
    const state = code(camera, own * images.every, point);
    const [column, row] = [imageKeypoints[start], imageKeypoints[start + 1]];
    if (!state || Number.isNaN(column)) continue;
    const [x, y] = place(column, row), there = place(column + imageResiduals[start], row + imageResiduals[start + 1]);
    context.strokeStyle = colour('reprojection');
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(there[0], there[1]);
    context.stroke();
    ring(context, there[0], there[1], 3.4, colour('reprojection'), 1.1);
    if (state === ASIDE) cross(context, x, y, 3.2, colour('aside'));
    else dot(context, x, y, 1.9, colour('used'));
    if (state === RELABELLED) ring(context, x, y, 5.2, colour('relabelled'));
  }
}

function drawClouds() {
  document.querySelectorAll('canvas.cloud').forEach((canvas) => drawCloud(canvas, Number(canvas.dataset.camera)));
}

/** Residuals along x and y, used ones and those set aside. */
function drawCloud(canvas, camera) {
  const sheet = cleared(canvas);
  if (!sheet) return;
  const { context, width, height } = sheet;
  const limit = data.cameras[camera].limit, scale = width / 2 / limit;
  context.strokeStyle = colour('line');
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(width / 2, 0);
  context.lineTo(width / 2, height);
  context.moveTo(0, height / 2);
  context.lineTo(width, height / 2);
  context.stroke();
  const { cloud, aside } = statistics[camera];
  context.globalAlpha = 0.55;
  for (const [found, ink] of [[cloud, colour('used')], [aside, colour('aside')]]) {
    for (let index = 0; index < found.length; index += 2) {
      const [x, y] = [width / 2 + scale * found[index], height / 2 + scale * found[index + 1]];
      if (x >= 0 && y >= 0 && x <= width && y <= height) dot(context, x, y, 1.2, ink);
    }
  }
  context.globalAlpha = 1;
  context.font = '10px system-ui, "DejaVu Sans", sans-serif';
  context.fillStyle = colour('soft');
  context.fillText(`±${written(limit, 2)} px`, 4, height - 5);
}
