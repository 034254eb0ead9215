// Curves of the optimisation, and the cameras from above.
import { css, data, digits, gradient, heat, make, onSelect, percent, select, u8, viridis } from './data.js';
import { axes, dense, sparse } from './scene.js';

const TERMS = {
  loss: 'Weighted sum that is lowered', photometric: 'Colours: rendered against seen', warped: 'Colours: looked up against seen', sparse: 'Error at the points that are used',
  geometric: 'Depths: rendered against predicted', depth: 'Departure from given depths', cameras: 'Departure from COLMAP’s cameras', smoothness: 'Roughness of what the depths were changed by', hidden: 'Error at points that were hidden', held_out: 'Error at held-out points, of the view of each step',
  rotation: 'Rotations against COLMAP’s', translation: 'Centres against COLMAP’s', focal: 'Focal lengths against COLMAP’s',
  own_rotation: 'The network’s own cameras: rotations', own_translation: 'The network’s own cameras: centres', own_focal: 'The network’s own cameras: focal lengths',
};
// Terms that only the steps on the depths have.
const DEPTHS = ['warped', 'smoothness'];

// How many steps were on the network: those before the first on the depths.
function onNetwork(columns) {
  const firsts = DEPTHS.map((name) => (columns[name] || []).findIndex((v) => v !== null)).filter((i) => i >= 0);
  return Math.min(columns.loss?.length || 0, firsts.length ? Math.min(...firsts) : data.report.settings.tco.steps);
}

// Mean over the last `width` values that are there, those before and from `turn` on apart.
function smooth(values, width, turn) {
  return values.map((_, i) => {
    const part = values.slice(Math.max(i < turn ? 0 : turn, i - width + 1), i + 1).filter((v) => v !== null);
    return part.length ? part.reduce((a, b) => a + b, 0) / part.length : null;
  });
}

function line(values, x, y) {
  let out = '', pen = 'M';
  values.forEach((v, i) => { if (v !== null) { out += `${pen}${x(i).toFixed(1)} ${y(v).toFixed(1)}`; pen = 'L'; } });
  return out;
}

function curve(name, values, width, turn) {
  const there = values.filter((v) => v !== null && Number.isFinite(v));
  if (!there.length) return null;
  const mean = smooth(values, width, turn), high = Math.max(...there) || 1, least = Math.min(...there), low = least > 0.3 * high ? least - 0.15 * (high - least) : Math.min(0, least), n = Math.max(1, values.length - 1);
  const x = (i) => 54 + 256 * i / n, y = (v) => 118 - 104 * (v - low) / (high - low || 1), show = name === 'held_out' ? percent : digits;
  const svg = make('svg', { viewBox: '0 0 320 140', role: 'img', 'aria-label': `${TERMS[name] || name}, from ${show(there[0])} to ${show(there[there.length - 1])}` },
    make('line', { class: 'axis', x1: 54, x2: 310, y1: 118, y2: 118 }), make('line', { class: 'axis', x1: 54, x2: 54, y1: 14, y2: 118 }),
    make('text', { x: 50, y: 18, 'text-anchor': 'end' }, show(high)), make('text', { x: 50, y: 121, 'text-anchor': 'end' }, show(low)),
    make('text', { x: 54, y: 133 }, '1'), make('text', { x: 310, y: 133, 'text-anchor': 'end' }, `step ${values.length}`),
    turn && turn < values.length ? make('line', { class: 'turn', x1: x(turn - 0.5), x2: x(turn - 0.5), y1: 14, y2: 118 }) : null,
    make('path', { class: 'raw', d: line(values, x, y) }), make('path', { class: 'mean', d: line(mean.slice(0, turn), x, y) + line(mean.map((v, i) => (i < turn ? null : v)), x, y) }));
  return make('figure', { 'data-term': name }, make('h3', {}, TERMS[name] || name.replaceAll('_', ' ')), svg);
}

export function startCurves(holder) {
  const chunks = data.loss.filter((columns) => Object.keys(columns).length);
  if (!chunks.length) { holder.append(make('p', { class: 'soft' }, 'Nothing was optimised (--steps 0): the network was used as it is.')); return; }
  const grid = make('div', { class: 'grid' }), parts = make('p', { class: 'parts' }), draw = (index) => {
    const columns = chunks[index], names = Object.keys(columns), first = ['loss', 'held_out'].filter((n) => names.includes(n));
    const steps = columns.loss?.length || 0, width = Math.max(3, Math.round(steps / 8)), turn = onNetwork(columns);
    grid.replaceChildren(...[...first, ...names.filter((n) => !first.includes(n))].map((n) => curve(n, columns[n], width, turn)).filter(Boolean));
    parts.textContent = turn < steps ? `Steps 1 to ${turn} adapt the network; from the dashed line on, steps ${turn + 1} to ${steps} refine the depths themselves.` : `All ${steps} steps are on the network.`;
  };
  if (chunks.length > 1) {
    const choice = make('select', { onchange: (e) => draw(+e.target.value), 'aria-label': 'Group of views' }, ...chunks.map((_, i) => make('option', { value: i }, `${i + 1} of ${chunks.length}`)));
    holder.append(make('p', {}, 'Group of views that was optimised together: ', choice));
  }
  holder.append(parts, grid, make('p', { class: 'hint' }, 'Thin: each step, which looks at another view, so that it jumps. Thick: running mean. Each term has a scale of its own; their weights are among the settings.'));
  draw(0);
}

// Cells of the map that hold points, number of the cell → mean number of views that saw these, 0 where that is not known.
const CELL = 4, WIDE = 1000;
function coverage(places, seen) {
  const cells = new Map();
  places.forEach(([x, y], i) => {
    const key = WIDE * Math.floor(y / CELL) + Math.floor(x / CELL), [sum, count] = cells.get(key) || [0, 0];
    if (x >= 0 && y >= 0 && x < CELL * WIDE) cells.set(key, [sum + (seen ? seen[i] : 0), count + 1]);
  });
  return new Map([...cells].map(([key, [sum, count]]) => [key, sum / count]));
}

export function startMap(holder) {
  const used = data.views.filter((view) => view.axes), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const flat = (p) => [dot(axes[0], p), dot(axes[2], p)];
  const spots = used.map((view) => flat(view.centre)), points = dense.length ? dense : sparse, ground = [];
  for (let i = 0; i < points.length; i += 3) ground.push(flat([points[i], points[i + 1], points[i + 2]]));
  const range = (k) => { const list = ground.map((p) => p[k]).sort((a, b) => a - b), cut = (q) => list[Math.floor(q * (list.length - 1))]; return [Math.min(...spots.map((p) => p[k]), cut(0.02) ?? Infinity), Math.max(...spots.map((p) => p[k]), cut(0.98) ?? -Infinity)]; };
  const [x0, x1] = range(0), [y0, y1] = range(1), W = 760, H = 460, scale = Math.min((W - 60) / (x1 - x0 || 1), (H - 60) / (y1 - y0 || 1));
  const at = (p) => [W / 2 + scale * (p[0] - (x0 + x1) / 2), H / 2 + scale * (p[1] - (y0 + y1) / 2)];
  const canvas = make('canvas', { width: W, height: H }), context = canvas.getContext('2d');
  const cells = coverage(ground.map(at), dense.length ? u8(data.cloud.seen) : null), means = [...cells.values()].filter(Boolean).sort((a, b) => a - b);
  const few = Math.floor(means[Math.floor(0.02 * means.length)] ?? 0), many = Math.ceil(means[Math.floor(0.98 * (means.length - 1))] ?? 0);
  cells.forEach((mean, key) => {
    context.fillStyle = mean ? css(viridis((mean - few) / (many - few || 1))) : 'rgba(128,138,150,.5)';
    context.fillRect(CELL * (key % WIDE), CELL * Math.floor(key / WIDE), CELL, CELL);
  });
  const errors = used.map((view) => view.error_at_held_out ?? view.error_at_points ?? 0), worst = Math.max(1e-3, ...errors), best = Math.min(...errors, worst);
  const svg = make('svg', { viewBox: `0 0 ${W} ${H}`, style: 'position:absolute;inset:0', role: 'group', 'aria-label': 'Cameras from above' });
  const order = used.map((_, i) => i);
  order.forEach((i) => {
    const view = used[i], [x, y] = at(spots[i]), ahead = flat(view.axes[2]), turn = Math.atan2(ahead[1], ahead[0]), open = Math.atan(view.half[0]), r = 24;
    const corner = (a) => `${x + r * Math.cos(turn + a)} ${y + r * Math.sin(turn + a)}`;
    svg.append(make('g', { class: 'view', 'data-name': view.name, onclick: () => select(view.name) }, make('title', {}, `${view.name}: ${percent(errors[i])}`),
      make('path', { d: `M${x} ${y}L${corner(-open)}A${r} ${r} 0 0 1 ${corner(open)}Z`, fill: css(heat((errors[i] - best) / (worst - best || 1))), 'fill-opacity': 0.9 })));
  });
  onSelect((name) => { for (const group of svg.children) { group.classList.toggle('on', group.dataset.name === name); } svg.querySelector('.on') && svg.append(svg.querySelector('.on')); });
  const bar = (of, low, high) => [make('div', { class: 'scale', style: `background:${gradient(of)}` }), make('div', { class: 'ends' }, make('span', {}, low), make('span', {}, high))];
  holder.append(make('div', { class: 'two' },
    make('figure', {}, make('div', { style: 'position:relative' }, canvas, svg)),
    make('figure', { 'data-legend': 'seen' }, make('h3', {}, 'Ground: number of views that saw the points'), ...(means.length ? bar(viridis, `${few} views`, `${many} views`) : []),
      make('p', { class: 'small soft' }, means.length ? 'Mean over what lies above each other. Empty: no point of the cloud; few views: take more pictures of it.' : 'There is no cloud; grey: COLMAP’s points.'),
      make('h3', { class: 'next' }, 'Cameras: median error at held-out points'), ...bar(heat, percent(best), percent(worst)),
      make('p', { class: 'small soft' }, 'Each wedge is a camera: where it stands, where it looks and how wide. Up is the mean of what is up in the pictures. Click one to see its maps.'))));
}
