// Reads what quantise.py wrote.
export const data = JSON.parse(document.getElementById('data').textContent);

const bytes = (text) => {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
};
export const u8 = bytes;
export const i8 = (text) => new Int8Array(bytes(text).buffer);
export const u16 = (text) => new Uint16Array(bytes(text).buffer);
export const f32 = (text) => new Float32Array(bytes(text).buffer);

export const level = (code, { low, high }) => (code ? low * (high / low) ** ((code - 1) / 254) : 0);

// Pixels (RGBA) of a data URI.
export async function pixels(uri, width, height) {
  const image = new Image();
  image.src = uri;
  await image.decode();
  const canvas = document.createElement('canvas');
  canvas.width = width; canvas.height = height;
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.drawImage(image, 0, 0, width, height);
  return context.getImageData(0, 0, width, height);
}

// Colours: [r, g, b] of a place in 0..1.
const ramp = (stops) => (t) => {
  const at = Math.min(Math.max(t, 0), 1) * (stops.length - 1), i = Math.min(Math.floor(at), stops.length - 2);
  return stops[i].map((v, k) => v + (at - i) * (stops[i + 1][k] - v));
};
export const viridis = ramp([[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]]);
export const warm = ramp([[252, 253, 191], [254, 194, 135], [251, 135, 97], [222, 73, 104], [165, 44, 122], [101, 26, 128], [40, 17, 89], [10, 6, 30]]);
export const heat = ramp([[254, 224, 139], [253, 174, 97], [244, 109, 67], [215, 48, 39], [140, 10, 38]]);
export const signed = ramp([[33, 102, 172], [103, 169, 207], [240, 240, 240], [239, 138, 98], [178, 24, 43]]);
export const css = (c) => `rgb(${c.map(Math.round).join(',')})`;
export const gradient = (of) => `linear-gradient(to right, ${Array.from({ length: 9 }, (_, i) => css(of(i / 8))).join(',')})`;

// Text and elements.
export function make(tag, attributes = {}, ...children) {
  const svg = ['svg', 'path', 'line', 'text', 'circle', 'g', 'rect', 'title', 'image'].includes(tag);
  const element = svg ? document.createElementNS('http://www.w3.org/2000/svg', tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith('on')) element.addEventListener(key.slice(2), value);
    else if (value !== undefined && value !== null && value !== false) element.setAttribute(key, value === true ? '' : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}
export const percent = (value, digits = 2) => (value === null || value === undefined ? '–' : `${(100 * value).toFixed(digits)} %`);
export const count = (value) => (value === null || value === undefined ? '–' : value.toLocaleString('en').replaceAll(',', '\u202f'));
export const digits = (value) => (value === 0 ? '0' : Math.abs(value) >= 1e5 || Math.abs(value) < 1e-3 ? value.toExponential(1) : String(+value.toPrecision(3)));

// The one selected view.
const listeners = [];
export const onSelect = (call) => listeners.push(call);
export const select = (name) => listeners.forEach((call) => call(name));
