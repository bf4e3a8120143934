/** Lays a camera's pictures on the floor, in a process beside the page: it takes longer than a frame of the map. */

import { warpOf } from "./floorwarp.js";

/** @import { FloorMesh } from "./types.d.ts" */
/** @import { Warp } from "./floorwarp.js" */

const MOST_SENT = 4_000_000; // pixels of a picture

/**
 * @typedef {{jpeg: string, mesh: FloorMesh, height_m: number}} Job  height_m: of the plane that it is to scale for
 * @typedef {{image: ImageBitmap, left: number, top: number, cell_m: number, width: number, height: number, work_ms: number}} Laid
 *   left, top: x and y of the upper left corner, m
 */

let warp = /** @type {Warp | null} */ (null);
let made = ""; // what `warp` is for

addEventListener("message", async ({ data }) => {
  const began_ms = performance.now();
  const laid = await lay(/** @type {Job} */ (data)).catch(() => null); // no picture, or one whose grid is none
  if (laid) postMessage({ ...laid, work_ms: performance.now() - began_ms }, { transfer: [laid.image] });
  else postMessage(null);
});

/** @param {Job} job */
async function lay({ jpeg, mesh, height_m }) {
  const bytes = Uint8Array.from(atob(jpeg), (letter) => letter.charCodeAt(0));
  const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  const { width, height } = bitmap;
  if (width * height > MOST_SENT) return null;
  const wanted = JSON.stringify([mesh, height_m, width, height]);
  if (wanted !== made) [warp, made] = [warpOf(mesh, width, height, height_m), wanted];
  if (!warp) return null;
  const flat = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  flat?.drawImage(bitmap, 0, 0);
  bitmap.close();
  const source = flat && new Uint32Array(flat.getImageData(0, 0, width, height).data.buffer);
  if (!source) return null;
  const image = new ImageData(warp.width, warp.height);
  const target = new Uint32Array(image.data.buffer);
  const { from } = warp;
  for (let k = 0; k < from.length; k += 1) if (from[k] >= 0) target[k] = source[from[k]];
  const { left, top, cell_m } = warp;
  return { image: await createImageBitmap(image), left, top, cell_m, width: warp.width, height: warp.height };
}
