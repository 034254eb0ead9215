// The strip of views, and the maps of the one that is selected.
import { css, data, digits, f32, gradient, heat, level, make, onSelect, percent, pixels, select, signed, u16, u8, viridis, warm } from './data.js';

const WORST = 0.05; // relative error at which the colours of the dots end
const shown = { used: true, held: true };

function strip(holder) {
  data.views.filter((view) => view.axes).forEach((view) => {
    const picture = view.maps ? make('img', { src: view.maps.image, alt: '' }) : make('i');
    holder.append(make('button', { type: 'button', role: 'option', 'data-name': view.name, title: view.name, 'aria-selected': 'false', onclick: () => select(view.name) }, picture, `\u200e${view.name}`));
  });
}

// Values between which 96 % of the codes of a map lie.
function middle(codes, range) {
  const counts = new Array(256).fill(0);
  let total = 0;
  for (const code of codes) if (code) { counts[code]++; total++; }
  const at = (share) => { let sum = 0; for (let c = 1; c < 256; c++) { sum += counts[c]; if (sum >= share * total) return level(c, range); } return range.high; };
  return total ? [at(0.02), at(0.98)] : [range.low, range.high];
}

async function codesOf(uri, maps) {
  const image = await pixels(uri, maps.width, maps.height), codes = new Uint8Array(maps.width * maps.height);
  for (let i = 0; i < codes.length; i++) codes[i] = image.data[4 * i];
  return codes;
}

function canvasOf(maps, colour) {
  const canvas = make('canvas', { width: maps.width, height: maps.height }), context = canvas.getContext('2d');
  const image = context.createImageData(maps.width, maps.height);
  for (let i = 0; i < maps.width * maps.height; i++) image.data.set([...colour(i), 255], 4 * i);
  context.putImageData(image, 0, 0);
  return canvas;
}
const NONE = [128, 128, 128];

function figure(title, kind, drawing, ...below) {
  return make('figure', { 'data-map': kind }, make('h3', {}, title), drawing, ...below);
}
const scale = (of, low, high, unit = '') => [
  make('div', { class: 'scale', style: `background:${gradient(of)}` }),
  make('div', { class: 'ends' }, make('span', {}, low + unit), make('span', {}, high + unit)),
];

function drawDots(canvas, points) {
  const context = canvas.getContext('2d'), r = Math.max(2.2, canvas.width / 260);
  context.clearRect(0, 0, canvas.width, canvas.height);
  for (const held of [0, 1]) {
    if (!(held ? shown.held : shown.used)) continue;
    for (let i = 0; i < points.count; i++) {
      if (points.held[i] !== held) continue;
      const x = points.x[i] * canvas.width, y = points.y[i] * canvas.height;
      context.beginPath(); context.arc(x, y, held ? 1.5 * r : r, 0, 7);
      context.fillStyle = css(signed(0.5 + points.error[i] / (2 * WORST))); context.fill();
      context.lineWidth = held ? 0.55 * r : 0.25 * r; context.strokeStyle = held ? '#ffb000' : 'rgba(0,0,0,.55)'; context.stroke();
    }
  }
}

function pointsOf(view) {
  const xy = u16(view.errors.xy), n = view.errors.count;
  return { count: n, x: Float32Array.from({ length: n }, (_, i) => xy[2 * i] / 65535), y: Float32Array.from({ length: n }, (_, i) => xy[2 * i + 1] / 65535), error: f32(view.errors.error), held: u8(view.errors.held) };
}

function histogram(points) {
  const bins = 40, counts = [new Array(bins).fill(0), new Array(bins).fill(0)];
  for (let i = 0; i < points.count; i++) counts[points.held[i]][Math.min(bins - 1, Math.max(0, Math.floor((points.error[i] / (2 * WORST) + 0.5) * bins)))]++;
  const share = counts.map((list) => list.map((v) => v / Math.max(1, list.reduce((a, b) => a + b, 0)))), most = Math.max(...share[0], ...share[1], 1e-6);
  const svg = make('svg', { viewBox: '0 0 320 150', role: 'img', 'aria-label': 'Distribution of the errors at points' });
  const step = 300 / bins, path = (list) => list.map((v, i) => `${i ? 'L' : 'M'}${10 + i * step} ${122 - 110 * v / most}H${10 + (i + 1) * step}`).join('');
  svg.append(make('line', { class: 'axis', x1: 10, x2: 310, y1: 122, y2: 122 }), make('line', { class: 'axis', x1: 160, x2: 160, y1: 8, y2: 122 }));
  share[0].forEach((v, i) => svg.append(make('rect', { x: 10 + i * step, y: 122 - 110 * v / most, width: step - 0.8, height: 110 * v / most, style: 'fill:var(--used)' })));
  svg.append(make('path', { d: path(share[1]), style: 'fill:none;stroke:var(--held);stroke-width:2' }));
  [['−5 % (too near)', 10, 'start'], ['0', 160, 'middle'], ['+5 % (too far)', 310, 'end']].forEach(([text, x, anchor]) => svg.append(make('text', { x, y: 138, 'text-anchor': anchor }, text)));
  return svg;
}

let turn = 0;
async function show(holder, name) {
  const mine = ++turn, view = data.views.find((v) => v.name === name);
  const head = make('div', { class: 'viewhead' }, make('strong', {}, name),
    make('span', { class: 'soft' }, `error at held-out points ${percent(view.error_at_held_out)} (median of ${view.points_held_out}), within 5 %: ${percent(view.held_out_within_5_percent, 1)}`),
    make('span', { class: 'soft' }, `at points that were used ${percent(view.error_at_points)} (of ${view.points})`));
  if (!view.maps) { holder.replaceChildren(head, make('p', { class: 'soft' }, 'The maps of this view were left out to keep the page small; they are in stereo/.')); return; }
  const maps = view.maps, [depth, sure, apart, normal, image] = await Promise.all([codesOf(maps.depth.codes, maps), codesOf(maps.confidence.codes, maps), maps.error ? codesOf(maps.error.codes, maps) : null, pixels(maps.normal, maps.width, maps.height), pixels(maps.image, maps.width, maps.height)]);
  if (mine !== turn) return;
  const spoken = apart?.some((code) => code > 0), [near, far] = middle(depth, maps.depth), [doubt, trust] = middle(sure, maps.confidence), [least, most] = spoken ? middle(apart, maps.error) : [1, 1];
  const distance = (z) => (far > near ? Math.log(z / near) / Math.log(far / near) : 0.5), sureness = (c) => (trust > doubt ? Math.log(c / doubt) / Math.log(trust / doubt) : 0.5), apartness = (e) => (most > least ? Math.log(e / least) / Math.log(most / least) : 0.5);
  const points = pointsOf(view), factor = Math.max(1, Math.round(900 / maps.width));
  const dots = make('canvas', { width: maps.width * factor, height: maps.height * factor });
  const redraw = () => drawDots(dots, points);
  const box = (key, text) => make('label', {}, make('input', { type: 'checkbox', checked: shown[key], onchange: (e) => { shown[key] = e.target.checked; redraw(); } }), ` ${text}`);
  redraw();
  const read = make('p', { class: 'read', 'aria-live': 'off' }, 'Point at a map to read its values.');
  const figures = make('div', { class: 'maps' }, ...[
    figure('Picture, and error of the depth at COLMAP’s points', 'image', make('div', { class: 'over' }, canvasOf(maps, (i) => image.data.subarray(4 * i, 4 * i + 3)), dots), ...scale(signed, '−5 % too near', '+5 % too far'),
      make('div', { class: 'choices' }, box('used', 'points that were used'), box('held', 'held-out points (ringed)'))),
    figure('Depth', 'depth', canvasOf(maps, (i) => (depth[i] ? warm(distance(level(depth[i], maps.depth))) : NONE)), ...scale(warm, digits(near), digits(far))),
    figure('Confidence', 'confidence', canvasOf(maps, (i) => (sure[i] ? viridis(sureness(level(sure[i], maps.confidence))) : NONE)), ...scale(viridis, digits(doubt), digits(trust))),
    spoken && figure('Standard error of the depth', 'error', canvasOf(maps, (i) => (apart[i] ? heat(apartness(level(apart[i], maps.error))) : NONE)), ...scale(heat, percent(least), percent(most)),
      make('p', { class: 'small soft' }, 'By how far apart the views were that see the place. Grey: too few do.')),
    figure('Normals', 'normal', canvasOf(maps, (i) => { const c = [0, 1, 2].map((k) => (normal.data[4 * i + k] - 128) / 124); return c[0] || c[1] || c[2] ? [128 + 127 * c[0], 128 - 127 * c[1], 128 - 127 * c[2]] : NONE; }),
      make('p', { class: 'small soft' }, 'Red: right, green: up, blue: towards the camera.')),
    figure('Errors at points', 'errors', histogram(points), make('p', { class: 'small soft' }, 'Bars: used. Line: held out. The last bars hold all that is worse.'))].filter(Boolean));
  figures.addEventListener('pointermove', (event) => {
    const canvas = event.target.closest('canvas');
    if (!canvas) return;
    const area = canvas.getBoundingClientRect(), u = (event.clientX - area.left) / area.width, v = (event.clientY - area.top) / area.height;
    const x = Math.min(maps.width - 1, Math.max(0, Math.floor(u * maps.width))), y = Math.min(maps.height - 1, Math.max(0, Math.floor(v * maps.height))), i = y * maps.width + x;
    let best = 0.012, near_ = '';
    for (let p = 0; p < points.count; p++) { const d = Math.hypot(points.x[p] - u, (points.y[p] - v) * maps.height / maps.width); if (d < best) { best = d; near_ = `, point ${points.held[p] ? 'held out' : 'used'}: ${percent(points.error[p])}`; } }
    read.textContent = `pixel ${x}, ${y}: depth ${depth[i] ? digits(level(depth[i], maps.depth)) : 'none'}, confidence ${sure[i] ? digits(level(sure[i], maps.confidence)) : 'none'}${spoken ? `, standard error ${apart[i] ? percent(level(apart[i], maps.error)) : 'none'}` : ''}${near_}`;
  });
  holder.replaceChildren(head, figures, read);
  holder.dataset.name = name;
}

export function startViews(holder, list) {
  strip(list);
  onSelect((name) => {
    for (const button of list.children) {
      const on = button.dataset.name === name;
      button.setAttribute('aria-selected', String(on));
      if (on) list.scrollTo({ left: button.offsetLeft - list.clientWidth / 2 + button.clientWidth / 2, behavior: 'auto' });
    }
    if (data.views.find((v) => v.name === name)?.axes) show(holder, name);
  });
  list.addEventListener('keydown', (event) => {
    const next = { ArrowRight: 'nextElementSibling', ArrowLeft: 'previousElementSibling' }[event.key];
    const to = next && document.activeElement[next];
    if (to) { event.preventDefault(); to.focus(); to.click(); }
  });
}
