// Curves and maps as SVG, drawn at the width that they have on the page.

/** The namespace of SVG, as the browser knows it. */
const SVG = (() => {
  const holder = document.createElement('div');
  holder.innerHTML = '<svg></svg>';
  return holder.firstChild.namespaceURI;
})();
const places = Math.ceil(data.count / data.time.size);
const MARGIN = { left: 52, right: 12, top: 8, bottom: 30 };

function element(parent, name, attributes = {}, text = '') {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  parent.appendChild(made);
  return made;
}

/** About so many round numbers from one to another. */
function ticks(low, high, wanted) {
  const rough = (high - low) / Math.max(1, wanted) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const found = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9 * step; value += step) found.push(Math.abs(value) < 1e-9 * step ? 0 : value);
  return found;
}

/** An empty chart with its axes; gives back where values lie in it. */
function chart(place, { x, y, height = 190, xName = '', yName = '', left = MARGIN.left, yText = (value) => written(value, 4) }) {
  place.textContent = '';
  const width = place.clientWidth || 600;
  const svg = element(place, 'svg', { viewBox: `0 0 ${width} ${height}`, height, role: 'img' });
  const at = {
    svg, width, height, left, right: width - MARGIN.right, top: MARGIN.top, bottom: height - MARGIN.bottom,
    x: (value) => left + ((value - x[0]) / (x[1] - x[0] || 1)) * (width - MARGIN.right - left),
    y: (value) => height - MARGIN.bottom - ((value - y[0]) / (y[1] - y[0] || 1)) * (height - MARGIN.bottom - MARGIN.top),
  };
  for (const value of ticks(x[0], x[1], width / 90)) {
    element(svg, 'text', { x: at.x(value), y: at.bottom + 14, 'text-anchor': 'middle' }, written(value, 6));
  }
  if (yName !== null) {
    for (const value of ticks(y[0], y[1], height / 45)) {
      element(svg, 'line', { x1: left, x2: at.right, y1: at.y(value), y2: at.y(value), style: 'stroke:var(--grid)' });
      element(svg, 'text', { x: left - 6, y: at.y(value) + 4, 'text-anchor': 'end' }, yText(value));
    }
    element(svg, 'text', { x: 12, y: (at.top + at.bottom) / 2, transform: `rotate(-90 12 ${(at.top + at.bottom) / 2})`, 'text-anchor': 'middle' }, yName);
  }
  element(svg, 'text', { x: at.right, y: at.bottom + 27, 'text-anchor': 'end' }, xName);
  element(svg, 'clipPath', { id: `clip-${place.dataset.chart}-${place.dataset.number || ''}` });
  element(svg.lastChild, 'rect', { x: left, y: at.top - 2, width: Math.max(0, at.right - left), height: at.bottom - at.top + 4 });
  at.clip = `url(#${svg.lastChild.id})`;
  return at;
}

/** A line through values; it has gaps where they are not known. */
function curve(at, xs, ys, ink, width = 1.3) {
  let path = '', open = false, alone = '';
  xs.forEach((x, index) => {
    const known = Number.isFinite(ys[index]);
    if (known) path += `${open ? 'L' : 'M'}${at.x(x).toFixed(1)} ${at.y(ys[index]).toFixed(1)}`;
    if (known && !open && !Number.isFinite(ys[index + 1])) alone += `M${at.x(x).toFixed(1)} ${at.y(ys[index]).toFixed(1)}h.01`;
    open = known;
  });
  element(at.svg, 'path', { d: path, 'clip-path': at.clip, style: `fill:none;stroke:${ink};stroke-width:${width}` });
  if (alone) element(at.svg, 'path', { d: alone, style: `fill:none;stroke:${ink};stroke-width:3;stroke-linecap:round` });
}

/** Times, or else frames, of the places of a curve over the session. */
const period = times !== null && times.length > 1 ? (times[times.length - 1] - times[0]) / (times.length - 1) / data.step : 0;
const along = Array.from({ length: places }, (_, place) => {
  const frame = Math.min(data.count - 1, (place + 0.5) * data.time.size - 0.5);
  return period ? times[0] + frame * period : frame;
});
const span = [period ? times[0] : 0, period ? times[0] + (data.count - 1) * period : Math.max(1, data.count - 1)];
const spanName = period ? 'time (s)' : 'frame';

function placeOf(frame) {
  return period ? times[frame] : frame * data.step;
}

function highest(values, share = 1) {
  const known = Array.from(values).filter(Number.isFinite).map(Math.abs).sort((a, b) => a - b);
  return known.length ? known[Math.min(known.length - 1, Math.floor(share * known.length))] : 1;
}

/** The names of the cameras in their colours, below a chart. */
function legend(place, names = data.cameras.map((camera) => camera.name), ink = (number) => cameraColour(number)) {
  const list = document.createElement('p');
  list.className = 'legend';
  names.forEach((name, number) => {
    const [entry, key] = [document.createElement('span'), document.createElement('i')];
    key.className = 'line';
    key.style.background = `var(--${ink(number)})`;
    entry.append(key, name);
    list.append(entry);
  });
  place.appendChild(list);
}

const CHARTS = {
  stick(place) {
    const stick = data.time.sticks[Number(place.dataset.number)];
    const [median, least, largest] = [stick.median, stick.least, stick.largest].map((packed) => numbers(packed).map((value) => 1000 * value));
    const missing = shares(stick.missing), tolerance = 1000 * stick.sigma_m;
    const limit = 1.2 * Math.max(highest([...least, ...largest], 0.99), tolerance, 0.01);
    const at = chart(place, { x: span, y: [-limit, limit], xName: spanName, yName: 'mm' });
    element(at.svg, 'rect', { x: at.left, width: Math.max(0, at.right - at.left), y: at.y(tolerance), height: at.y(-tolerance) - at.y(tolerance), style: 'fill:var(--used);opacity:.1' });
    let spread = '';
    along.forEach((x, index) => {
      if (least[index] < largest[index]) spread += `M${at.x(x).toFixed(1)} ${at.y(least[index]).toFixed(1)}V${at.y(largest[index]).toFixed(1)}`;
    });
    element(at.svg, 'path', { d: spread, 'clip-path': at.clip, style: 'stroke:var(--stick);opacity:.35' });
    curve(at, along, median, 'var(--stick)');
    let gaps = '';
    missing.forEach((share, index) => { if (share > 0) gaps += `M${at.x(along[index]).toFixed(1)} ${at.bottom - 1}v-7`; });
    if (gaps) element(at.svg, 'path', { d: gaps, style: 'stroke:var(--aside);stroke-width:1.5' });
    legend(place, ['length minus the given one', 'given, ± its standard deviation', ...(gaps ? ['frames left out'] : [])], (number) => ['stick', 'used', 'aside'][number]);
    return at;
  },
  residual: (place) => overTime(place, numbers(data.time.residual), 'px', 0),
  used: (place) => overTime(place, shares(data.time.used).map((share) => 100 * share), '%', 0, 100),
  visibility(place) {
    const values = shares(data.visibility.cameras), tall = Math.max(9, Math.min(16, 300 / P));
    const left = Math.min(130, (place.clientWidth || 600) / 3.2);
    const at = chart(place, { x: span, y: [0, 1], height: P * tall + MARGIN.top + MARGIN.bottom, xName: spanName, yName: null, left });
    const wide = (at.right - at.left) / places;
    for (let point = 0; point < P; point += 1) {
      const paths = {};
      for (let index = 0; index < places; index += 1) {
        const level = Math.round(10 * values[point * places + index]);
        const [x, y] = [at.left + index * wide, at.top + point * tall];
        if (level >= 0) paths[level] = (paths[level] || '') + `M${x.toFixed(2)} ${y.toFixed(1)}h${(wide + 0.3).toFixed(2)}v${(tall - 1).toFixed(1)}h${(-wide - 0.3).toFixed(2)}z`;
      }
      for (const [level, path] of Object.entries(paths)) {
        element(at.svg, 'path', { d: path, style: level === '0' ? 'fill:var(--aside);opacity:.35' : `fill:var(--used);opacity:${0.06 + 0.065 * level}` });
      }
      if (tall >= 9 || point % 3 === 0) element(at.svg, 'text', { x: at.left - 6, y: at.top + (point + 0.75) * tall, 'text-anchor': 'end', style: 'font-size:9.5px' }, scene.names[point]);
    }
    legend(place, ['all cameras', 'no camera'], (number) => ['used', 'aside'][number]);
    return at;
  },
  cost(place) {
    const least = 1e-8;
    const curves = data.stages.map(({ cost }) => cost.map((value) => Math.log10(Math.max(least, value / (cost[cost.length - 1] || 1) - 1))));
    const longest = Math.max(1, ...curves.map((values) => values.length - 1));
    const top = Math.max(1, Math.ceil(Math.max(...curves.flat().filter(Number.isFinite))));
    const at = chart(place, { x: [0, longest], y: [Math.log10(least), top], xName: 'iteration', yName: 'share', yText: (value) => `1e${value}` });
    curves.forEach((values, number) => curve(at, values.map((_, index) => index), values, `var(--${cameraColour(number)})`, 1.6));
    legend(place, data.stages.map((stage) => stage.name));
    return null;
  },
  reprojection(place) {
    const all = data.stages.flatMap((stage) => stage.reprojection).filter((values) => values.length === C);
    const at = chart(place, { x: [0, Math.max(1, all.length - 1)], y: [0, 1.1 * highest(all.flat(), 0.97)], xName: 'iteration, all stages', yName: 'px' });
    for (let camera = 0; camera < C; camera += 1) {
      curve(at, all.map((_, index) => index), all.map((values) => values[camera] ?? NaN), `var(--${cameraColour(camera)})`, 1.6);
    }
    legend(place);
    return null;
  },
};

/** A curve over the session for each camera. */
function overTime(place, values, unit, low, high = 1.15 * highest(values, 0.995)) {
  const at = chart(place, { x: span, y: [low, high], xName: spanName, yName: unit });
  for (let camera = 0; camera < C; camera += 1) {
    curve(at, along, values.slice(camera * places, (camera + 1) * places), `var(--${cameraColour(camera)})`);
  }
  legend(place);
  return at;
}

const marks = [];

function drawCharts() {
  marks.length = 0;
  document.querySelectorAll('.chart').forEach((place) => {
    const at = CHARTS[place.dataset.chart](place);
    if (at) marks.push({ at, line: element(at.svg, 'line', { class: 'now', y1: at.top, y2: at.bottom }) });
  });
}

/** Where the shown frame is on the curves over time. */
function markFrame(frame) {
  for (const { at, line } of marks) {
    const x = at.x(placeOf(frame));
    line.setAttribute('x1', x);
    line.setAttribute('x2', x);
  }
}
