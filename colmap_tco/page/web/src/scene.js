// The turning cloud: OGL draws, world coordinates become "display" ones, centred, up is +y, size about 1.
import { Camera, Geometry, Mesh, Orbit, Program, Renderer, Transform, Vec3 } from 'ogl';
import { data, i8, level, onSelect, select, u16, u8, viridis } from './data.js';

const POINT = {
  vertex: `attribute vec3 position, color; attribute float keep;
    uniform mat4 modelViewMatrix, projectionMatrix; uniform float size, height; varying vec3 tint;
    void main() { vec4 p = modelViewMatrix * vec4(position, 1.0); tint = color;
      gl_Position = keep > 0.5 ? projectionMatrix * p : vec4(2.0, 2.0, 2.0, 1.0);
      gl_PointSize = clamp(size * height / 900.0 * pow(1.0 / max(-p.z, 0.05), 0.6), 1.0, 40.0); }`,
  fragment: `precision mediump float; varying vec3 tint;
    void main() { vec2 d = gl_PointCoord - 0.5; if (dot(d, d) > 0.25) discard; gl_FragColor = vec4(tint, 1.0); }`,
};
const LINE = {
  vertex: `attribute vec3 position, color; uniform mat4 modelViewMatrix, projectionMatrix; varying vec3 tint;
    void main() { tint = color; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
  fragment: 'precision mediump float; varying vec3 tint; void main() { gl_FragColor = vec4(tint, 1.0); }',
};
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };
const median = (list) => [...list].sort((a, b) => a - b)[list.length >> 1] ?? 0;

// Display axes: y up, x across the mean viewing direction.
const used = data.views.filter((view) => view.axes);
function frame() {
  const up = unit(data.up);
  let ahead = used.reduce((sum, v) => sum.map((s, i) => s + v.axes[2][i]), [0, 0, 0]);
  ahead = ahead.map((v, i) => v - dot(ahead, up) * up[i]);
  if (Math.hypot(...ahead) < 1e-6) ahead = cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 0, 1]);
  ahead = unit(ahead);
  return [unit(cross(ahead, up)), up, ahead.map((v) => -v)];
}
export const axes = frame();

function place(cloud) {
  const codes = u16(cloud.xyz), out = new Float64Array(codes.length);
  for (let i = 0; i < codes.length; i++) out[i] = cloud.corner[i % 3] + codes[i] * cloud.step[i % 3];
  return out;
}
export const dense = place(data.cloud), sparse = place(data.sparse);

// Centre and size of what the middle 90 % of the points fill.
function fit() {
  const points = dense.length ? dense : sparse, stride = 3 * Math.max(1, Math.floor(points.length / 3 / 5000));
  const lists = [[], [], []];
  for (let i = 0; i < points.length; i += stride) for (let k = 0; k < 3; k++) lists[k].push(dot(axes[k], [points[i], points[i + 1], points[i + 2]]));
  if (!lists[0].length) lists.forEach((list, k) => list.push(...used.map((v) => dot(axes[k], v.centre)), 0));
  const low = [], high = [], cameras = [0, 1, 2].map((k) => used.map((v) => dot(axes[k], v.centre)).sort((a, b) => a - b));
  lists.forEach((list) => { list.sort((a, b) => a - b); low.push(list[Math.floor(0.05 * list.length)]); high.push(list[Math.min(list.length - 1, Math.floor(0.95 * list.length))]); });
  // The cameras too, unless they are so far away that the scene would be a speck.
  const span = Math.max(...high.map((v, k) => v - low[k]));
  cameras.forEach((list, k) => { if (list.length) { low[k] = Math.min(low[k], Math.max(list[0], low[k] - span)); high[k] = Math.max(high[k], Math.min(list[list.length - 1], high[k] + span)); } });
  return { middle: low.map((v, k) => (v + high[k]) / 2), extent: Math.max(...high.map((v, k) => v - low[k])) || 1 };
}
const { middle, extent } = fit();
export const display = (p) => axes.map((axis, k) => (dot(axis, p) - middle[k]) / extent);

function displayed(world) {
  const out = new Float32Array(world.length);
  for (let i = 0; i < world.length; i += 3) out.set(display([world[i], world[i + 1], world[i + 2]]), i);
  return out;
}
const filled = (length, value) => new Float32Array(length).fill(value);

function colours(kind) {
  const n = data.cloud.count, out = new Float32Array(3 * n);
  const rgb = u8(data.cloud.rgb), normal = i8(data.cloud.normal), seen = u8(data.cloud.seen), sure = u8(data.cloud.confidence.codes);
  const most = Math.max(2, seen.reduce((a, b) => Math.max(a, b), 0));
  for (let i = 0; i < n; i++) {
    let c = [rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]];
    if (kind === 'normal') { const v = [normal[3 * i], normal[3 * i + 1], normal[3 * i + 2]]; c = axes.map((axis) => 128 + dot(axis, v)); }
    if (kind === 'seen') c = viridis(seen[i] / most);
    if (kind === 'confidence') c = viridis(sure[i] / 255);
    for (let k = 0; k < 3; k++) out[3 * i + k] = c[k] / 255;
  }
  return out;
}

const EDGES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [5, 6], [6, 7], [7, 5]];
function frusta() {
  const size = frustumSize();
  const out = new Float32Array(used.length * EDGES.length * 6);
  used.forEach((view, index) => {
    const [w, h] = view.half, corners = [[0, 0, 0], [-w, -h, 1], [w, -h, 1], [w, h, 1], [-w, h, 1], [-0.4 * w, -1.1 * h, 1], [0.4 * w, -1.1 * h, 1], [0, -1.5 * h, 1]];
    const world = corners.map((c) => display([0, 1, 2].map((k) => view.centre[k] + size * (c[0] * view.axes[0][k] + c[1] * view.axes[1][k] + c[2] * view.axes[2][k]))));
    EDGES.forEach(([a, b], e) => out.set([...world[a], ...world[b]], (index * EDGES.length + e) * 6));
  });
  return out;
}
function frustumSize() {
  const steps = used.slice(1).map((view, i) => Math.hypot(...view.centre.map((c, k) => c - used[i].centre[k])));
  return Math.min(Math.max(0.8 * median(steps), 0.02 * extent), 0.12 * extent);
}

export function startScene(canvas, note, form) {
  let renderer;
  try { renderer = new Renderer({ canvas, dpr: Math.min(devicePixelRatio || 1, 2), antialias: true, alpha: true, preserveDrawingBuffer: true }); } catch { renderer = null; }
  if (!renderer || !renderer.gl) { note.hidden = false; note.textContent = 'This browser offers no WebGL, so the cloud cannot be drawn; everything below works without it.'; return; }
  const { gl } = renderer, camera = new Camera(gl, { fov: 40, near: 0.005, far: 100 }), scene = new Transform();
  if (!data.cloud.count) { note.hidden = false; note.textContent = data.report.no_points || 'The cloud is empty.'; form.elements.sparse.checked = true; }
  gl.clearColor(0, 0, 0, 0);

  const uniforms = { size: { value: 1.5 }, height: { value: 600 } }, thick = { size: { value: 4 }, height: { value: 600 } };
  const points = (positions, colour, shared) => {
    const geometry = new Geometry(gl, { position: { size: 3, data: positions }, color: { size: 3, data: colour }, keep: { size: 1, data: filled(positions.length / 3, 1) } });
    return new Mesh(gl, { mode: gl.POINTS, geometry, program: new Program(gl, { ...POINT, uniforms: shared }), frustumCulled: false });
  };
  const denseMesh = points(displayed(dense), colours('picture'), uniforms);
  const held = u8(data.sparse.held), rgb = u8(data.sparse.rgb), sparseColour = new Float32Array(rgb.length);
  for (let i = 0; i < rgb.length; i++) sparseColour[i] = held[Math.floor(i / 3)] ? [1, 0.6, 0][i % 3] : [0.2, 0.55, 0.9][i % 3];
  const sparseMesh = points(displayed(sparse), sparseColour, thick);
  const lines = frusta(), lineGeometry = new Geometry(gl, { position: { size: 3, data: lines }, color: { size: 3, data: filled(lines.length, 0.5) } });
  const lineMesh = new Mesh(gl, { mode: gl.LINES, geometry: lineGeometry, program: new Program(gl, LINE), frustumCulled: false });
  if (data.cloud.count) denseMesh.setParent(scene);
  if (data.sparse.count) sparseMesh.setParent(scene);
  if (used.length) lineMesh.setParent(scene);

  let orbit, chosen = null;
  const look = (position, target) => {
    orbit?.remove();
    camera.position.set(...position);
    orbit = new Orbit(camera, { element: canvas, target: new Vec3(...target), rotateSpeed: 0.25, panSpeed: 0.25, ease: 0.35, inertia: 0.7, minDistance: 0.02, maxDistance: 20 });
  };
  const whole = () => { camera.perspective({ fov: 40 }); look([0.3, 0.36, 1.15], [0, 0, 0]); };
  const through = () => {
    const view = used.find((v) => v.name === chosen);
    if (!view) return;
    const shape = canvas.clientWidth / canvas.clientHeight, half = Math.max(view.half[1], view.half[0] / shape);
    camera.perspective({ fov: (2 * Math.atan(half) * 180) / Math.PI });
    const ahead = view.centre.map((c, k) => c + 0.5 * extent * view.axes[2][k]);
    form.elements.turn.checked = false;
    look(display(view.centre), display(ahead));
  };
  form.elements.size.value = Math.min(6, Math.max(1, Math.round(2 * 900 * Math.sqrt(1.4 / Math.max(1, data.cloud.count))) / 2));
  whole();

  const resize = () => {
    canvas.style.width = canvas.style.height = "";
    const { clientWidth: w, clientHeight: h } = canvas;
    renderer.setSize(w, h); canvas.style.width = ''; canvas.style.height = '';
    uniforms.height.value = thick.height.value = h * renderer.dpr;
    camera.perspective({ aspect: w / h });
  };
  addEventListener('resize', resize);
  resize();

  const seen = u8(data.cloud.seen), sure = u8(data.cloud.confidence.codes);
  form.elements.least.max = Math.max(1, Math.min(60, seen.reduce((a, b) => Math.max(a, b), 0)));
  const filter = () => {
    const least = +form.elements.least.value, code = Math.round(1 + 2.54 * form.elements.sure.value), keep = denseMesh.geometry.attributes.keep;
    for (let i = 0; i < seen.length; i++) keep.data[i] = seen[i] >= least && (sure[i] >= code || !+form.elements.sure.value) ? 1 : 0;
    keep.needsUpdate = true;
    form.elements['least-out'].value = least;
    form.elements['sure-out'].value = +form.elements.sure.value ? level(code, data.cloud.confidence).toFixed(1) : 'all';
  };
  const apply = () => {
    const f = form.elements;
    denseMesh.visible = f.dense.checked; sparseMesh.visible = f.sparse.checked; lineMesh.visible = f.frusta.checked;
    uniforms.size.value = +f.size.value; thick.size.value = Math.max(4, 1.6 * f.size.value); f['size-out'].value = f.size.value;
    filter();
  };
  form.addEventListener('input', (event) => {
    if (event.target.name === 'colour') { const c = denseMesh.geometry.attributes.color; c.data = colours(event.target.value); c.needsUpdate = true; } else apply();
  });
  form.elements.reset.addEventListener('click', whole);
  form.elements.through.addEventListener('click', through);
  if (matchMedia('(prefers-reduced-motion: reduce)').matches) form.elements.turn.checked = false;
  apply();

  const paint = (name) => {
    chosen = name;
    const c = lineGeometry.attributes.color, dark = matchMedia('(prefers-color-scheme: dark)').matches;
    used.forEach((view, index) => {
      const tint = view.name === name ? [0.95, 0.45, 0.1] : dark ? [0.55, 0.6, 0.68] : [0.35, 0.4, 0.47];
      for (let i = 0; i < EDGES.length * 2; i++) c.data.set(tint, (index * EDGES.length * 2 + i) * 3);
    });
    c.needsUpdate = true;
  };
  onSelect(paint);

  // A click that did not drag selects the camera nearest to it.
  let down = null;
  canvas.addEventListener('pointerdown', (event) => { down = [event.offsetX, event.offsetY]; form.elements.turn.checked = false; });
  canvas.addEventListener('click', (event) => {
    if (!down || Math.hypot(event.offsetX - down[0], event.offsetY - down[1]) > 4) return;
    let best = 18, hit = null;
    used.forEach((view) => {
      const p = new Vec3(...display(view.centre));
      camera.project(p);
      const d = Math.hypot((p[0] + 1) / 2 * canvas.clientWidth - event.offsetX, (1 - p[1]) / 2 * canvas.clientHeight - event.offsetY);
      if (d < best && p[2] < 1) { best = d; hit = view.name; }
    });
    if (hit) select(hit);
  });
  canvas.addEventListener('keydown', (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key], zoom = { '+': 0.9, '=': 0.9, '-': 1.1 }[event.key];
    if (!step && !zoom) return;
    event.preventDefault();
    form.elements.turn.checked = false;
    const at = [0, 1, 2].map((k) => camera.position[k] - orbit.target[k]), r = Math.hypot(...at) * (zoom || 1);
    const theta = Math.atan2(at[0], at[2]) + 0.1 * (step ? step[0] : 0), phi = Math.min(Math.max(Math.acos(at[1] / Math.hypot(...at)) - 0.1 * (step ? step[1] : 0), 0.01), 3.13);
    camera.position.set(orbit.target[0] + r * Math.sin(phi) * Math.sin(theta), orbit.target[1] + r * Math.cos(phi), orbit.target[2] + r * Math.sin(phi) * Math.cos(theta));
    orbit.forcePosition();
  });

  let visible = true, before = performance.now();
  new IntersectionObserver((entries) => { visible = entries[entries.length - 1].isIntersecting; }).observe(canvas);
  const draw = (now) => {
    requestAnimationFrame(draw);
    const dt = Math.min(now - before, 100); before = now;
    if (!visible) return;
    if (form.elements.turn.checked) {
      const at = [camera.position[0] - orbit.target[0], camera.position[2] - orbit.target[2]], a = dt * 1.2e-4;
      camera.position[0] = orbit.target[0] + at[0] * Math.cos(a) + at[1] * Math.sin(a);
      camera.position[2] = orbit.target[2] - at[0] * Math.sin(a) + at[1] * Math.cos(a);
      orbit.forcePosition();
    }
    orbit.update();
    renderer.render({ scene, camera });
    canvas.dataset.frames = String(+(canvas.dataset.frames || 0) + 1);
  };
  requestAnimationFrame(draw);
}
