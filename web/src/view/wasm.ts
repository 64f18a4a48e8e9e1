/** Spark's WebAssembly, when something first waits for it. */

let read = async (url: string): Promise<ArrayBuffer> => {
  const reply = await fetch(url);
  if (!reply.ok) throw new Error(`Part of the viewer is missing (${reply.status}); copy the bundle again.`);
  return reply.arrayBuffer();
};

/** Takes it from elsewhere than its URL. */
export function readFrom(other: (url: string) => Promise<ArrayBuffer>): void {
  read = other;
}

/** A module to await, which is not asked for before. */
export function lazy(url: string): PromiseLike<WebAssembly.Module> {
  let module: Promise<WebAssembly.Module> | undefined;
  return {
    // biome-ignore lint/suspicious/noThenProperty: Spark awaits it
    then(resolve, reject) {
      module ??= read(url).then((bytes) => WebAssembly.compile(bytes));
      return module.then(resolve, reject);
    },
  };
}
