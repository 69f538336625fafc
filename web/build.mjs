// Build the player into a folder of the Python package: the page, its script, the licences of its libraries, and
// morgs-spark.js, the module for other pages.
//
//     node build.mjs FOLDER
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { resolve } from "node:path";
import asc from "assemblyscript/asc";
import * as esbuild from "esbuild";

// AssemblyScript's compiler adds its runtime to the compiled range code.
const BUNDLED = ["three", "@sparkjsdev/spark", "fflate", "assemblyscript"];
const settings = {
  absWorkingDir: import.meta.dirname,
  bundle: true,
  minify: true,
  write: false,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  logLevel: "warning",
};

const generated = {
  name: "generated",
  setup(build) {
    build.onResolve({ filter: /^(wasm|worker):/ }, ({ path }) => ({ path, namespace: "generated" }));
    build.onLoad({ filter: /^wasm:/, namespace: "generated" }, async ({ path }) => {
      return { contents: await compiled(path.slice("wasm:".length)), loader: "binary" };
    });
    build.onLoad({ filter: /^worker:/, namespace: "generated" }, async () => {
      return { contents: await bundle("src/worker.ts"), loader: "text" };
    });
  },
};

async function compiled(name) {
  let wasm;
  const options = [`wasm/${name}.ts`, "-O3", "--runtime", "stub", "--noAssert", "--use", "abort=", "--outFile", "out.wasm"];
  const { error, stderr } = await asc.main(options, {
    readFile: (path) => readFile(new URL(path, import.meta.url), "utf8").catch(() => null),
    writeFile: (_, contents) => (wasm = contents),
    listFiles: () => [],
  });
  if (error) throw new Error(stderr.toString());
  return wasm;
}

async function notice() {
  const parts = await Promise.all(
    BUNDLED.map(async (name) => {
      const folder = `node_modules/${name}`;
      const { version, license } = JSON.parse(await readFile(`${folder}/package.json`, "utf8"));
      const texts = ["LICENSE", "NOTICE"].map((file) => readFile(`${folder}/${file}`, "utf8").catch(() => ""));
      return `${name} ${version} (${license})\n\n${(await Promise.all(texts)).join("\n\n").trimEnd()}\n`;
    }),
  );
  return `The web player contains these libraries; of assemblyscript, it contains the runtime.\n\n${parts.join("\n" + "-".repeat(80) + "\n\n")}`;
}

async function bundle(entry, options) {
  const { outputFiles } = await esbuild.build({ ...settings, entryPoints: [entry], plugins: [generated], ...options });
  return outputFiles[0].text;
}

const BANNER = `/* Streams of morgs-mi in scenes of three.js with Spark: docs/web-player.md. BSD-3-Clause, Copyright (c) 2026, The
morgs_mi authors. It contains the runtime of AssemblyScript, under the Apache License 2.0. */`;

const folder = resolve(process.argv[2]);
process.chdir(import.meta.dirname);
await mkdir(folder, { recursive: true });
await writeFile(`${folder}/player.js`, await bundle("src/main.ts"));
const external = { format: "esm", external: ["three", "@sparkjsdev/spark"], banner: { js: BANNER } };
await writeFile(`${folder}/morgs-spark.js`, await bundle("src/morgs_spark.ts", external));
await writeFile(`${folder}/player.html`, await readFile("src/player.html", "utf8"));
await writeFile(`${folder}/NOTICE`, await notice());
