// Bundles the page into ../built/page.html: npm ci && npm run build
import { createHash } from 'node:crypto';
import { readFile, readdir, writeFile, mkdir } from 'node:fs/promises';
import { build } from 'esbuild';

const here = (path) => new URL(path, import.meta.url);
const ogl = JSON.parse(await readFile(here('node_modules/ogl/package.json'), 'utf8'));
const credit = `/* Includes OGL ${ogl.version} (https://github.com/oframe/ogl), released into the public domain (${ogl.license}). */`;
const bundled = async (path) => {
  const result = await build({
    entryPoints: [here(path).pathname], bundle: true, minify: true, write: false, format: 'iife',
    target: ['es2020'], legalComments: 'none', charset: 'ascii',
  });
  return result.outputFiles[0].text.trim();
};
const script = await bundled('src/main.js');
if (script.includes('</script')) throw new Error('the script would end itself');
const style = await bundled('src/style.css');
// What the page was built from, which a test compares with what is there.
const sources = createHash('sha256');
for (const name of ['build.mjs', 'package-lock.json', ...(await readdir(here('src/'))).sort().map((file) => `src/${file}`)]) {
  sources.update(`${name}\n`).update(await readFile(here(name)));
}
const page = (await readFile(here('src/page.html'), 'utf8'))
  .replace('SOURCES', () => sources.digest('hex'))
  .replace('/* STYLE */', () => style)
  .replace('/* SCRIPT */', () => `${credit}\n${script}`);
await mkdir(here('../built/'), { recursive: true });
await writeFile(here('../built/page.html'), page);
