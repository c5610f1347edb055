/* Writes vendor_map.js, vendor_map.css and vendor_mesh.js, which the page carries.

   npm ci && npm run build

   The versions are those of package-lock.json; the same versions give the same bytes. */
import {readFileSync, writeFileSync} from "node:fs";
import {build} from "esbuild";

const lock = JSON.parse(readFileSync("package-lock.json", "utf8"));

function banner(name) {
  const {version, license} = lock.packages[`node_modules/${name}`];
  const text = readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim();
  return `/*! ${name} ${version} (${license})\n\n${text}\n*/`;
}

async function bundle(entry, out, name, extra) {
  await build({
    entryPoints: [entry],
    outfile: out,
    bundle: true,
    minify: true,
    target: "es2020",
    legalComments: "none",
    charset: "utf8",
    loader: {".png": "dataurl"},
    banner: {js: banner(name), css: banner(name)},
    logLevel: "warning",
    ...extra,
  });
}

await bundle("entry_map.js", "vendor_map.js", "leaflet", {format: "iife", globalName: "leaflet"});
await bundle("node_modules/leaflet/dist/leaflet.css", "vendor_map.css", "leaflet", {});
await bundle("entry_mesh.js", "vendor_mesh.js", "three", {format: "iife", globalName: "three"});

const used = ["leaflet", "three"].map((name) => {
  const text = readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim();
  return `${name} ${lock.packages[`node_modules/${name}`].version}\n\n${text}\n`;
});
writeFileSync("LICENCES", used.join(`\n${"-".repeat(72)}\n\n`));
