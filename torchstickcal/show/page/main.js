// The page: the slider moves the scene, the images and the marks on the curves.

const slider = document.getElementById('frame');
const play = document.getElementById('play');
let playing = null;

function shownFrame() {
  return Number(slider.value);
}

function drawMoving() {
  const frame = shownFrame();
  document.getElementById('when').textContent = moment(frame);
  drawScene(frame);
  drawImages(frame);
  markFrame(frame);
}

function drawAll() {
  drawCharts();
  drawClouds();
  drawMoving();
}

function stop() {
  cancelAnimationFrame(playing);
  playing = null;
  play.textContent = '\u25b6';
  play.setAttribute('aria-label', 'play');
}

/** Play in real time where the times are known. */
function start() {
  const perSecond = (period ? 1 / period : 30) / data.step;
  const from = shownFrame() >= frames - 1 ? 0 : shownFrame(), began = performance.now();
  play.textContent = '\u275a\u275a';
  play.setAttribute('aria-label', 'pause');
  const step = (now) => {
    const frame = Math.min(frames - 1, from + Math.max(0, Math.floor(((now - began) / 1000) * perSecond)));
    slider.value = frame;
    drawMoving();
    if (frame < frames - 1) playing = requestAnimationFrame(step);
    else stop();
  };
  playing = requestAnimationFrame(step);
}

let waiting = null;
function later(draw) {
  cancelAnimationFrame(waiting);
  waiting = requestAnimationFrame(draw);
}

/** The frame in which most points are known, of the first third. */
function bestFrame() {
  let best = 0, most = -1;
  for (let frame = 0; frame < Math.max(1, frames / 3); frame += 1) {
    let known = 0;
    for (let point = 0; point < P; point += 1) known += Number.isNaN(points[3 * (frame * P + point)]) ? 0 : 1;
    if (known > most) [best, most] = [frame, known];
  }
  return best;
}

slider.max = Math.max(0, frames - 1);
slider.value = bestFrame();
slider.addEventListener('input', () => { stop(); drawMoving(); });
play.addEventListener('click', () => (playing === null ? start() : stop()));
document.querySelectorAll('input[name=mode], #enlarge').forEach((input) => input.addEventListener('change', drawMoving));
listenToScene(() => later(() => drawScene(shownFrame())));
window.addEventListener('resize', () => later(drawAll));
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', drawAll);
for (const [event, on] of [['beforeprint', true], ['afterprint', false]]) {
  window.addEventListener(event, () => {
    document.documentElement.classList.toggle('printing', on);
    drawAll();
  });
}
drawAll();
