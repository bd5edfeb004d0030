// The data of the page, and the frame that is shown.

const UNKNOWN = -32768;
const data = JSON.parse(document.getElementById('data').textContent);

function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

/** Numbers that were packed as 16-bit integers with a factor; NaN where not known. */
function numbers(packed) {
  const view = new DataView(bytes(packed.int16).buffer);
  return Float32Array.from({ length: view.byteLength / 2 }, (_, index) => {
    const value = view.getInt16(2 * index, true);
    return value === UNKNOWN ? NaN : value * packed.factor;
  });
}

/** Numbers of which the roots were packed. */
function squares(packed) {
  return numbers(packed).map((root) => root * Math.abs(root));
}

/** Shares from 0 to 1; NaN where not known. */
function shares(text) {
  return Float32Array.from(bytes(text), (value) => (value === 255 ? NaN : value / 250));
}

function floats(text) {
  const view = new DataView(bytes(text).buffer);
  return Float32Array.from({ length: view.byteLength / 4 }, (_, index) => view.getFloat32(4 * index, true));
}

const SEEN = 1, ASIDE = 2, RELABELLED = 3;
const P = data.scene.names.length;
const C = data.cameras.length;
const points = numbers(data.scene.points);
const frames = points.length / (3 * P);
const packedCodes = bytes(data.scene.codes);
const times = data.times === null ? null : floats(data.times);

/** What became of a keypoint: 0 not seen, SEEN (and used), ASIDE or RELABELLED. */
function code(camera, frame, point) {
  const index = (camera * frames + frame) * P + point;
  return (packedCodes[index >> 2] >> (2 * (index & 3))) & 3;
}

/** A point of a drawn frame, around the middle of the scene; null where not known. */
function pointAt(frame, point) {
  const start = 3 * (frame * P + point);
  return Number.isNaN(points[start]) ? null : [points[start], points[start + 1], points[start + 2]];
}

/** A colour of the page by its name. */
function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim();
}

function cameraColour(camera) {
  return 'c' + (camera % 10);
}

/** A number for people. */
function written(value, significant = 3) {
  return Number.isFinite(value) ? String(Number(value.toPrecision(significant))) : '-';
}

/** When a drawn frame was, in words. */
function moment(frame) {
  const number = frame * data.step;
  return times === null ? `frame ${number}` : `frame ${number}, ${times[frame].toFixed(2)} s`;
}

/** A canvas of the size that it has on the page, cleared; null where it has none. */
function cleared(canvas) {
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return null;
  const scale = Math.max(2, window.devicePixelRatio || 1);
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const context = canvas.getContext('2d');
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  context.lineCap = context.lineJoin = 'round';
  return { context, width, height };
}

function ring(context, x, y, radius, ink, width = 1.5) {
  context.strokeStyle = ink;
  context.lineWidth = width;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.stroke();
}

function dot(context, x, y, radius, ink) {
  context.fillStyle = ink;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

function cross(context, x, y, radius, ink) {
  context.strokeStyle = ink;
  context.lineWidth = 1.6;
  context.beginPath();
  context.moveTo(x - radius, y - radius);
  context.lineTo(x + radius, y + radius);
  context.moveTo(x + radius, y - radius);
  context.lineTo(x - radius, y + radius);
  context.stroke();
}
