// Curves of the optimisation, and the cameras from above.
import { css, data, digits, make, onSelect, percent, select, viridis } from './data.js';
import { axes, dense, sparse } from './scene.js';

const TERMS = {
  loss: 'Weighted sum that is lowered', photometric: 'Colours: rendered against seen', warped: 'Colours: looked up against seen', sparse: 'Error at the points that are used', consistency: 'Disagreement of the depths of two views',
  geometric: 'Depths: rendered against predicted', depth: 'Departure from given depths', cameras: 'Departure from COLMAP’s cameras', hidden: 'Error at points that were hidden', held_out: 'Error at held-out points, of the view of each step',
};

// Mean over the last `width` values that are there.
function smooth(values, width) {
  return values.map((_, i) => {
    const part = values.slice(Math.max(0, i - width + 1), i + 1).filter((v) => v !== null);
    return part.length ? part.reduce((a, b) => a + b, 0) / part.length : null;
  });
}

function line(values, x, y) {
  let out = '', pen = 'M';
  values.forEach((v, i) => { if (v !== null) { out += `${pen}${x(i).toFixed(1)} ${y(v).toFixed(1)}`; pen = 'L'; } });
  return out;
}

function curve(name, values, width) {
  const there = values.filter((v) => v !== null && Number.isFinite(v));
  if (!there.length) return null;
  const mean = smooth(values, width), high = Math.max(...there) || 1, least = Math.min(...there), low = least > 0.3 * high ? least - 0.15 * (high - least) : Math.min(0, least), n = Math.max(1, values.length - 1);
  const x = (i) => 54 + 256 * i / n, y = (v) => 118 - 104 * (v - low) / (high - low || 1), show = name === 'held_out' ? percent : digits;
  const svg = make('svg', { viewBox: '0 0 320 140', role: 'img', 'aria-label': `${TERMS[name] || name}, from ${show(there[0])} to ${show(there[there.length - 1])}` },
    make('line', { class: 'axis', x1: 54, x2: 310, y1: 118, y2: 118 }), make('line', { class: 'axis', x1: 54, x2: 54, y1: 14, y2: 118 }),
    make('text', { x: 50, y: 18, 'text-anchor': 'end' }, show(high)), make('text', { x: 50, y: 121, 'text-anchor': 'end' }, show(low)),
    make('text', { x: 54, y: 133 }, '1'), make('text', { x: 310, y: 133, 'text-anchor': 'end' }, `step ${values.length}`),
    make('path', { class: 'raw', d: line(values, x, y) }), make('path', { class: 'mean', d: line(mean, x, y) }));
  return make('figure', { 'data-term': name }, make('h3', {}, TERMS[name] || name.replaceAll('_', ' ')), svg);
}

export function startCurves(holder) {
  const chunks = data.loss.filter((columns) => Object.keys(columns).length);
  if (!chunks.length) { holder.append(make('p', { class: 'soft' }, 'Nothing was optimised (--steps 0): the network was used as it is.')); return; }
  const grid = make('div', { class: 'grid' }), draw = (index) => {
    const columns = chunks[index], names = Object.keys(columns), first = ['loss', 'held_out'].filter((n) => names.includes(n));
    const steps = columns.loss?.length || 0, width = Math.max(3, Math.round(steps / 8));
    grid.replaceChildren(...[...first, ...names.filter((n) => !first.includes(n))].map((n) => curve(n, columns[n], width)).filter(Boolean));
  };
  if (chunks.length > 1) {
    const choice = make('select', { onchange: (e) => draw(+e.target.value), 'aria-label': 'Group of views' }, ...chunks.map((_, i) => make('option', { value: i }, `${i + 1} of ${chunks.length}`)));
    holder.append(make('p', {}, 'Group of views that was optimised together: ', choice));
  }
  holder.append(grid, make('p', { class: 'hint' }, 'Thin: each step, which looks at another view, so that it jumps. Thick: running mean. Each term has a scale of its own; their weights are among the settings.'));
  draw(0);
}

export function startMap(holder) {
  const used = data.views.filter((view) => view.axes), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const flat = (p) => [dot(axes[0], p), dot(axes[2], p)];
  const spots = used.map((view) => flat(view.centre)), points = dense.length ? dense : sparse, ground = [];
  const stride = 3 * Math.max(1, Math.floor(points.length / 3 / 30000));
  for (let i = 0; i < points.length; i += stride) ground.push(flat([points[i], points[i + 1], points[i + 2]]));
  const range = (k) => { const list = ground.map((p) => p[k]).sort((a, b) => a - b), cut = (q) => list[Math.floor(q * (list.length - 1))]; return [Math.min(...spots.map((p) => p[k]), cut(0.02) ?? Infinity), Math.max(...spots.map((p) => p[k]), cut(0.98) ?? -Infinity)]; };
  const [x0, x1] = range(0), [y0, y1] = range(1), W = 760, H = 460, scale = Math.min((W - 60) / (x1 - x0 || 1), (H - 60) / (y1 - y0 || 1));
  const at = (p) => [W / 2 + scale * (p[0] - (x0 + x1) / 2), H / 2 + scale * (p[1] - (y0 + y1) / 2)];
  const canvas = make('canvas', { width: W, height: H }), context = canvas.getContext('2d');
  context.fillStyle = matchMedia('(prefers-color-scheme: dark)').matches ? 'rgba(200,210,225,.35)' : 'rgba(50,60,75,.28)';
  ground.forEach((p) => { const [x, y] = at(p); context.fillRect(x, y, 1.2, 1.2); });
  const errors = used.map((view) => view.error_at_held_out ?? view.error_at_points ?? 0), worst = Math.max(1e-3, ...errors), best = Math.min(...errors, worst);
  const svg = make('svg', { viewBox: `0 0 ${W} ${H}`, style: 'position:absolute;inset:0', role: 'group', 'aria-label': 'Cameras from above' });
  const order = used.map((_, i) => i);
  order.forEach((i) => {
    const view = used[i], [x, y] = at(spots[i]), ahead = flat(view.axes[2]), turn = Math.atan2(ahead[1], ahead[0]), open = Math.atan(view.half[0]), r = 24;
    const corner = (a) => `${x + r * Math.cos(turn + a)} ${y + r * Math.sin(turn + a)}`;
    svg.append(make('g', { class: 'view', 'data-name': view.name, onclick: () => select(view.name) }, make('title', {}, `${view.name}: ${percent(errors[i])}`),
      make('path', { d: `M${x} ${y}L${corner(-open)}A${r} ${r} 0 0 1 ${corner(open)}Z`, fill: css(viridis((errors[i] - best) / (worst - best || 1))), 'fill-opacity': 0.75 })));
  });
  onSelect((name) => { for (const group of svg.children) { group.classList.toggle('on', group.dataset.name === name); } svg.querySelector('.on') && svg.append(svg.querySelector('.on')); });
  const bar = make('div', { class: 'scale', style: `background:linear-gradient(to right, ${Array.from({ length: 9 }, (_, i) => css(viridis(i / 8))).join(',')})` });
  holder.append(make('div', { class: 'two' },
    make('figure', {}, make('div', { style: 'position:relative' }, canvas, svg)),
    make('figure', {}, make('h3', {}, 'Median error at held-out points'), bar, make('div', { class: 'ends' }, make('span', {}, percent(best)), make('span', {}, percent(worst))),
      make('p', { class: 'small soft' }, 'Each wedge is a camera: where it stands, where it looks and how wide. Up is the mean of what is up in the pictures. Grey: the cloud. Click one to see its maps.'))));
}
