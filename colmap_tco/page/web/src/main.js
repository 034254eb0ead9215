import { count, data, digits, make, onSelect, percent, select } from './data.js';
import { startCurves, startMap } from './charts.js';
import { startScene } from './scene.js';
import { startViews } from './views.js';

const id = (name) => document.getElementById(name), report = data.report;
const total = Object.values(report.seconds).reduce((a, b) => a + b, 0);
const time = (s) => (s < 90 ? `${s.toFixed(s < 10 ? 1 : 0)} s` : `${(s / 60).toFixed(1)} min`);

function head() {
  document.title = `${data.title}: colmap-tco`;
  const held = report.held_out, left = report.images.skipped + report.images.failed, facts = [
    [count(report.points), data.cloud.all > data.cloud.count ? `points (${count(data.cloud.count)} on this page)` : 'points'],
    [count(report.images.used), `views used${left ? `, ${left} left out` : ''}`],
    [percent(held.median_error), `median error at ${count(held.points)} held-out points`],
    [percent(held.within_5_percent, 1), 'of them within 5 %'],
    [report.backbone.name, `network, on ${report.device}`],
    [time(total), report.seconds.optimisation < 0.1 ? 'in this run; the depth maps were there' : 'in all'],
  ];
  id('head').append(make('h1', {}, data.title), make('ul', { class: 'facts' }, ...facts.map(([value, name]) => make('li', {}, make('b', {}, value), make('span', {}, name)))));
  // Reports of earlier versions have no doubts in words.
  const doubt = report.doubt ?? (held.plausible ? '' : 'the depths contradict COLMAP’s points: do not use them');
  if (doubt) id('head').append(make('p', { class: 'warn' }, `${doubt[0].toUpperCase()}${doubt.slice(1)}.`));
  if (report.no_points) id('head').append(make('p', { class: 'warn' }, report.no_points));
}

function rows() {
  const names = [['name', 'Image'], ['state', 'State'], ['error_at_held_out', 'Error held out', percent], ['held_out_within_5_percent', 'Within 5 %', (v) => percent(v, 1)], ['points_held_out', 'Held out', count], ['error_at_points', 'Error used', percent], ['points', 'Used', count], ['reprojection_error_pixels', 'Keypoints (px)', (v) => (v ?? null) === null ? '–' : v.toFixed(2)], ['turned', 'Camera turned', (v) => v === undefined ? '–' : `${v.toFixed(3)}°`], ['why', 'Why']];
  const body = data.views.map((view) => {
    const value = { ...view, turned: view.correction?.rotation_degrees };
    const cells = names.map(([key, , form]) => make('td', { class: form ? 'n' : key === 'state' ? `state-${view.state}` : '' }, form ? (value[key] === undefined ? '–' : form(value[key])) : value[key] ?? ''));
    return make('tr', view.axes ? { 'data-name': view.name, onclick: () => { select(view.name); id('views').scrollIntoView(); } } : {}, ...cells);
  });
  const table = make('table', {}, make('thead', {}, make('tr', {}, ...names.map(([, title, form]) => make('th', { scope: 'col', class: form ? 'n' : '' }, title)))), make('tbody', {}, ...body));
  id('rows').append(table);
  onSelect((name) => { for (const row of table.tBodies[0].rows) row.classList.toggle('on', row.dataset.name === name); });
}

// The names of columns that are two cells wide, after one for the rows' names.
const headed = (heads) => (heads.length ? make('thead', {}, make('tr', {}, make('td', {}), ...heads.map((head) => make('th', { scope: 'col', colspan: 2, class: 'n' }, head)))) : null);

// A table of rows [name, value, …], a bar beside each value; heads names the columns of values.
const bars = (title, entries, form, heads = []) => {
  const most = Math.max(...entries.flatMap(([, ...values]) => values), 1e-9), wide = 40 / Math.max(1, heads.length);
  return make('figure', {}, make('h3', {}, title), make('table', {},
    headed(heads), make('tbody', {}, ...entries.map(([name, ...values]) => make('tr', {}, make('th', { scope: 'row', style: 'font-weight:400' }, name.replaceAll('_', ' ')),
      ...values.flatMap((value) => [make('td', { class: 'n' }, form(value)), make('td', { style: `width:${wide}%` }, make('span', { class: 'bar', style: `width:${100 * value / most}%` }))]))))));
};

// The passes of the fusion: over the views' own depths, and over those that they agreed on, where there are gaps.
const passes = () => Object.entries({ 'each view’s own depths': report.fusion, 'gaps, of depths agreed on': report.fusion?.gaps }).filter(([, pass]) => pass?.pixels);

function fates() {
  const all = passes(), names = Object.keys(all[0]?.[1].pixels || {});
  return bars('What became of the pixels in the fusion', names.map((name) => [name, ...all.map(([, pass]) => pass.pixels[name])]), count, all.length > 1 ? all.map(([head]) => head) : []);
}

const TESTS = [['max_depth_error', 'depth', (v) => percent(v)], ['max_reproj_error', 'reproj', (v) => `${digits(v)} px`], ['max_normal_error', 'normal', (v) => `${digits(v)}°`]];
function agreement() {
  const all = passes().filter(([, pass]) => pass.tolerance);
  if (!all.length) return null;
  const body = TESTS.map(([test, key, form]) => make('tr', {}, make('th', { scope: 'row', style: 'font-weight:400' }, test.replaceAll('_', ' ')),
    ...all.flatMap(([, pass]) => [make('td', { class: 'n' }, form(pass.tolerance[key])), make('td', { class: 'n' }, `${count(pass.comparisons_failed[test])} failed`)])));
  return make('figure', { 'data-table': 'agreement' }, make('h3', {}, 'When a pixel and a neighbour agree'), make('table', {}, headed(all.length > 1 ? all.map(([head]) => head) : []), make('tbody', {}, ...body)),
    make('p', { class: 'small soft' }, 'The largest difference that was allowed, as set or widened to the noise of the depths, and how often it was the first that was exceeded.'));
}

function flat(value, prefix = '') {
  if (value === null || typeof value !== 'object' || Array.isArray(value)) return [[prefix, JSON.stringify(value)]];
  return Object.entries(value).flatMap(([key, item]) => flat(item, prefix ? `${prefix}.${key}` : key));
}
const listing = (title, value, open = false) => make('details', { open }, make('summary', {}, title),
  make('table', {}, make('tbody', {}, ...flat(value).map(([key, text]) => make('tr', {}, make('th', { scope: 'row', style: 'font-weight:400' }, key), make('td', {}, text))))));

function settings() {
  const holder = id('settings');
  holder.append(make('div', { class: 'two' }, fates(), make('div', { class: 'column' }, ...[agreement(), bars('Time', Object.entries(report.seconds), time)].filter(Boolean))),
    listing('Network, model and images', { backbone: report.backbone, device: report.device, ...report.workspace }),
    listing('Settings', report.settings), listing('Versions', report.versions));
  holder.append(make('footer', {}, 'Made by colmap-tco; the numbers are in report.json. This page needs no network.'));
}

head();
startScene(id('scene'), id('scene-note'), id('controls'));
startViews(id('view'), id('strip'));
startMap(id('map'));
startCurves(id('curves'));
rows();
settings();
const first = data.views.find((view) => view.axes && view.maps);
if (first) select(first.name);
