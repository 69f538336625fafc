/** What the build replaces: a compiled WebAssembly module, and the source of the worker. */
declare module "wasm:range_code" {
  const bytes: Uint8Array<ArrayBuffer>;
  export default bytes;
}

declare module "worker:decoder" {
  const source: string;
  export default source;
}
