// The scene in space: cameras, athlete and stick, turned by mouse, fingers or keys.

const scene = data.scene;
const space = document.getElementById('space');
const tip = document.getElementById('tip');
const [right, forward, up] = scene.axes;
const TRAIL = 40;
const NAME_PX = 30, MARGIN_PX = 34;
const START = { yaw: 0.45, pitch: 0.3, distance: 2.1 };
const orbit = { ...START };
let fromCamera = null;
let targets = [];

const dotted = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const sum = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const scaled = (a, factor) => a.map((value) => value * factor);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));

const corners = data.cameras.map((camera) => camera.corners.map((corner) => sum(corner, scene.middle, -1)));
const halfAxes = data.cameras.map((camera) => camera.ellipsoid);
const pointAxes = numbers(scene.ellipsoids.axes);
const magnified = magnification();
document.getElementById('magnified').textContent = `(drawn ${magnified} times as large)`;

/** By how much ellipsoids are magnified, so that a typical one can be seen: 1, 2, 5, 10, ... */
function magnification() {
  const sizes = halfAxes.filter(Boolean).map((axes) => Math.max(...axes.map((axis) => Math.hypot(...axis))));
  if (scene.ellipsoids.size_m) sizes.push(scene.ellipsoids.size_m);
  if (!sizes.length) return 1;
  const wanted = (0.05 * scene.radius) / sizes.sort((a, b) => a - b)[sizes.length - 1];
  const power = 10 ** Math.floor(Math.log10(wanted));
  return wanted < 1 ? 1 : Math.round(power * (wanted >= 5 * power ? 5 : wanted >= 2 * power ? 2 : 1));
}

/** The view: three directions (right, up, away from the eye), the eye, the focal length and the middle's height in pixels. */
function view(width, height) {
  if (fromCamera !== null) {
    const [apex, first, second, , fourth] = corners[fromCamera];
    const x = unit(sum(second, first, -1)), y = unit(sum(first, fourth, -1));
    const middle = scaled(corners[fromCamera].slice(1).reduce((a, b) => sum(a, b)), 0.25);
    const away = unit(sum(middle, apex, -1));
    const half = Math.hypot(...sum(second, first, -1)) / 2 / Math.hypot(...sum(middle, apex, -1));
    const tall = Math.hypot(...sum(fourth, first, -1)) / 2 / Math.hypot(...sum(middle, apex, -1));
    return { x, y, away, eye: apex, focal: Math.min(width / 2 / half, height / 2 / tall), horizon: height / 2 };
  }
  return { ...around(orbit), ...fitted(width, height) };
}

/** The focal length, and the height in the picture of the middle of the scene, with which all of it is seen at first. */
function fitted(width, height) {
  const seen = around(START);
  const athlete = Array.from({ length: P }, (_, point) => pointAt(0, point)).filter(Boolean);
  const places = [...corners.flat(), ...athlete].map((point) => {
    const from = sum(point, seen.eye, -1), depth = dotted(from, seen.away);
    return [dotted(from, seen.x) / depth, dotted(from, seen.y) / depth];
  });
  const half = Math.max(...places.map(([x]) => Math.abs(x)));
  const top = Math.max(...places.map(([, y]) => y)), bottom = Math.min(...places.map(([, y]) => y));
  const focal = Math.min((width / 2 - NAME_PX) / half, (height - 2 * MARGIN_PX) / (top - bottom), 2.5 * height);
  return { focal, horizon: height / 2 + (focal * (top + bottom)) / 2 };
}

/** Three directions and the eye of a view onto the middle of the scene. */
function around({ yaw, pitch, distance }) {
  const level = sum(scaled(forward, Math.cos(yaw)), right, Math.sin(yaw));
  const x = sum(scaled(right, Math.cos(yaw)), forward, -Math.sin(yaw));
  const away = sum(scaled(level, Math.cos(pitch)), up, -Math.sin(pitch));
  const y = sum(scaled(up, Math.cos(pitch)), level, Math.sin(pitch));
  return { x, y, away, eye: scaled(away, -distance * scene.radius) };
}

function drawScene(frame) {
  const sheet = cleared(space);
  if (!sheet) return;
  const { context, width, height } = sheet;
  const seen = view(width, height);
  const project = (point) => {
    const from = sum(point, seen.eye, -1);
    const depth = dotted(from, seen.away);
    if (depth < 0.02 * scene.radius) return null;
    return [width / 2 + (seen.focal * dotted(from, seen.x)) / depth, seen.horizon - (seen.focal * dotted(from, seen.y)) / depth, depth];
  };
  const line = (a, b, ink, thick, strength = 1) => {
    const from = project(a), to = project(b);
    if (!from || !to) return;
    context.globalAlpha = strength;
    context.strokeStyle = ink;
    context.lineWidth = thick;
    context.beginPath();
    context.moveTo(from[0], from[1]);
    context.lineTo(to[0], to[1]);
    context.stroke();
    context.globalAlpha = 1;
  };
  targets = [];
  drawFloor(line);
  drawAxes(context, line, project);
  if (shown('show-path')) drawPath(frame, line);
  if (shown('show-ellipsoids')) drawEllipsoids(context, frame, project);
  corners.forEach((pyramid, camera) => camera !== fromCamera && drawCamera(context, pyramid, camera, line, project));
  drawAthlete(context, frame, line, project);
}

function shown(id) {
  return document.getElementById(id).checked;
}

function drawFloor(line) {
  const size = Math.ceil(1.15 * scene.radius), step = size > 12 ? 5 : size > 60 ? 20 : 1;
  const at = (a, b) => sum(sum(scaled(right, a), forward, b), up, scene.floor);
  const ink = colour('floor');
  const reach = Math.ceil(size / step) * step;
  for (let place = -reach; place <= reach; place += step) {
    line(at(place, -reach), at(place, reach), ink, 1);
    line(at(-reach, place), at(reach, place), ink, 1);
  }
}

function drawAxes(context, line, project) {
  const origin = scaled(scene.middle, -1);
  ['x', 'y', 'z'].forEach((name, axis) => {
    const end = origin.slice();
    end[axis] += 0.14 * scene.radius;
    line(origin, end, colour('soft'), 1.5);
    const place = project(end);
    if (place) label(context, name, place, colour('soft'));
  });
}

function label(context, text, place, ink) {
  context.font = '12px system-ui, "DejaVu Sans", sans-serif';
  context.lineWidth = 3;
  context.strokeStyle = colour('wash');
  const x = Math.max(2, Math.min(place[0] + 4, context.canvas.clientWidth - context.measureText(text).width - 2));
  context.strokeText(text, x, place[1] - 4);
  context.fillStyle = ink;
  context.fillText(text, x, place[1] - 4);
}

/** Where the sticks were in the frames before and after, fainter the longer ago. */
function drawPath(frame, line) {
  const ink = colour('stick');
  scene.sticks.forEach(([first, second]) => {
    for (let other = Math.max(0, frame - TRAIL); other < Math.min(frames, frame + TRAIL); other += 1) {
      const near = 1 - Math.abs(other - frame) / TRAIL;
      const [a, b] = [pointAt(other, first), pointAt(other, second)];
      if (a && b) line(a, b, ink, 1, 0.05 + 0.2 * near * near);
    }
  });
}

/** An ellipsoid as the outline of its image: the image of its three axes spans an ellipse. */
function drawEllipsoid(context, centre, axes, ink, project) {
  const middle = project(centre);
  if (!middle) return;
  let xx = 0, xy = 0, yy = 0;
  for (const axis of axes) {
    const end = project(sum(centre, axis, magnified));
    if (!end) return;
    const [x, y] = [end[0] - middle[0], end[1] - middle[1]];
    xx += x * x;
    xy += x * y;
    yy += y * y;
  }
  const mean = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy);
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy);
  context.beginPath();
  context.ellipse(middle[0], middle[1], Math.sqrt(mean + spread), Math.sqrt(Math.max(0, mean - spread)), angle, 0, 2 * Math.PI);
  context.globalAlpha = 0.16;
  context.fillStyle = ink;
  context.fill();
  context.globalAlpha = 0.7;
  context.strokeStyle = ink;
  context.lineWidth = 1;
  context.stroke();
  context.globalAlpha = 1;
}

function drawEllipsoids(context, frame, project) {
  const count = scene.ellipsoids.frames;
  const own = frames > 1 ? Math.round((frame * (count - 1)) / (frames - 1)) : 0;
  for (let point = 0; point < P; point += 1) {
    const start = 9 * (own * P + point), centre = pointAt(frame, point);
    const axes = [0, 3, 6].map((offset) => Array.from(pointAxes.slice(start + offset, start + offset + 3)));
    if (centre && axes.flat().every(Number.isFinite)) drawEllipsoid(context, centre, axes, colour('used'), project);
  }
  halfAxes.forEach((axes, camera) => axes && drawEllipsoid(context, corners[camera][0], axes, colour(cameraColour(camera)), project));
}

function drawCamera(context, [apex, ...base], camera, line, project) {
  const ink = colour(cameraColour(camera));
  base.forEach((corner, number) => {
    line(apex, corner, ink, 1.4);
    line(corner, base[(number + 1) % 4], ink, number === 0 ? 3 : 1.4);
  });
  const place = project(apex);
  if (!place) return;
  targets.push({ place, text: data.cameras[camera].name });
  if (shown('show-names')) label(context, data.cameras[camera].name, place, ink);
}

function drawAthlete(context, frame, line, project) {
  const body = colour('body');
  for (const [first, second] of scene.bones) {
    const [a, b] = [pointAt(frame, first), pointAt(frame, second)];
    if (a && b) line(a, b, body, 2.5);
  }
  for (const [first, second] of scene.sticks) {
    const [a, b] = [pointAt(frame, first), pointAt(frame, second)];
    if (a && b) line(a, b, colour('stick'), 4);
  }
  for (let point = 0; point < P; point += 1) {
    const where = pointAt(frame, point), place = where && project(where);
    if (!place) continue;
    const codes = data.cameras.map((_, camera) => code(camera, frame, point));
    dot(context, place[0], place[1], 2.6, body);
    if (codes.includes(ASIDE)) ring(context, place[0], place[1], 5.5, colour('aside'));
    if (codes.includes(RELABELLED)) ring(context, place[0], place[1], 8, colour('relabelled'));
    targets.push({ place, text: told(point, where, codes) });
  }
}

/** What is known of a point, for whoever points at it. */
function told(point, where, codes) {
  const names = (wanted) => data.cameras.filter((_, camera) => codes[camera] === wanted).map((camera) => camera.name).join(', ');
  const lines = [scene.names[point], sum(where, scene.middle).map((value) => value.toFixed(3)).join('  ') + ' m'];
  for (const [wanted, words] of [[SEEN, 'used: '], [RELABELLED, 'relabelled: '], [ASIDE, 'set aside: '], [0, 'not seen: ']]) {
    if (codes.includes(wanted)) lines.push(words + names(wanted));
  }
  return lines.join('\n');
}

function point(event) {
  const box = space.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

function showTip(event) {
  const [x, y] = point(event);
  const nearest = targets
    .map((target) => ({ ...target, far: Math.hypot(target.place[0] - x, target.place[1] - y) }))
    .sort((a, b) => a.far - b.far)[0];
  tip.hidden = !nearest || nearest.far > 16;
  if (tip.hidden) return;
  tip.textContent = nearest.text;
  tip.style.left = Math.max(4, Math.min(x + 14, space.clientWidth - 230)) + 'px';
  tip.style.top = Math.max(4, Math.min(y + 14, space.clientHeight - 90)) + 'px';
}

function turned(dx, dy) {
  leaveCamera();
  orbit.yaw += 0.008 * dx;
  orbit.pitch = Math.max(-1.5, Math.min(1.5, orbit.pitch + 0.008 * dy));
}

function zoomed(factor) {
  leaveCamera();
  orbit.distance = Math.max(0.3, Math.min(12, orbit.distance * factor));
}

function leaveCamera() {
  fromCamera = null;
  document.getElementById('view').value = '';
}

/** Listen to whoever turns the scene; redraw() draws it again. */
function listenToScene(redraw) {
  const fingers = new Map();
  space.addEventListener('pointerdown', (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    space.setPointerCapture(event.pointerId);
    showTip(event);
  });
  space.addEventListener('pointermove', (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return showTip(event);
    const now = [event.clientX, event.clientY];
    tip.hidden = true;
    const others = [...fingers.keys()].filter((id) => id !== event.pointerId);
    if (others.length) {
      const other = fingers.get(others[0]);
      zoomed(Math.hypot(before[0] - other[0], before[1] - other[1]) / (Math.hypot(now[0] - other[0], now[1] - other[1]) || 1));
      turned(0, (now[1] - before[1]) / 2);
    } else {
      turned(now[0] - before[0], now[1] - before[1]);
    }
    fingers.set(event.pointerId, now);
    redraw();
    return undefined;
  });
  for (const end of ['pointerup', 'pointercancel']) space.addEventListener(end, (event) => fingers.delete(event.pointerId));
  space.addEventListener('pointerleave', () => { tip.hidden = true; });
  space.addEventListener('wheel', (event) => {
    if (!event.ctrlKey && document.activeElement !== space) return;
    event.preventDefault();
    zoomed(Math.exp(0.001 * event.deltaY));
    redraw();
  }, { passive: false });
  const keys = { ArrowLeft: () => turned(-12, 0), ArrowRight: () => turned(12, 0), ArrowUp: () => turned(0, 12), ArrowDown: () => turned(0, -12), '+': () => zoomed(0.85), '-': () => zoomed(1.18) };
  space.addEventListener('keydown', (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
    redraw();
  });
  const on = (id, kind, action) => document.getElementById(id).addEventListener(kind, () => { action(); redraw(); });
  on('nearer', 'click', () => zoomed(0.8));
  on('farther', 'click', () => zoomed(1.25));
  on('reset', 'click', () => { leaveCamera(); Object.assign(orbit, START); });
  on('view', 'change', () => {
    const chosen = document.getElementById('view').value;
    fromCamera = chosen === '' ? null : Number(chosen);
  });
  for (const id of ['show-names', 'show-path', 'show-ellipsoids']) on(id, 'change', () => {});
}
