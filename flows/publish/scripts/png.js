"use strict";
// Reads the numbers out of a PNG of one byte a pixel, as its writer put them in. A canvas would give colours, and some
// browsers change those on purpose.
function bytesOf(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let at = 0; at < text.length; at++) bytes[at] = text.charCodeAt(at);
  return bytes;
}

async function readPng(base64) {
  const bytes = bytesOf(base64), view = new DataView(bytes.buffer), packed = [];
  const width = view.getUint32(16), height = view.getUint32(20);
  if (bytes[24] !== 8 || (bytes[25] !== 3 && bytes[25] !== 0)) throw new Error("not a PNG of one byte a pixel");
  for (let at = 8; at < bytes.length; at += 12 + view.getUint32(at)) {
    if (view.getUint32(at + 4) === 0x49444154) packed.push(bytes.subarray(at + 8, at + 8 + view.getUint32(at)));
  }
  const stream = new Blob(packed).stream().pipeThrough(new DecompressionStream("deflate"));
  const rows = new Uint8Array(await new Response(stream).arrayBuffer());
  return { width, height, data: unfilter(rows, width, height) };
}

function unfilter(rows, width, height) {
  const data = new Uint8Array(width * height);
  for (let y = 0; y < height; y++) {
    const kind = rows[y * (width + 1)], from = y * (width + 1) + 1, to = y * width, up = to - width;
    for (let x = 0; x < width; x++) {
      const a = x ? data[to + x - 1] : 0, b = y ? data[up + x] : 0, c = x && y ? data[up + x - 1] : 0;
      let guess = 0;
      if (kind === 1) guess = a;
      else if (kind === 2) guess = b;
      else if (kind === 3) guess = (a + b) >> 1;
      else if (kind === 4) {
        const pa = Math.abs(b - c), pb = Math.abs(a - c), pc = Math.abs(a + b - 2 * c);
        guess = pa <= pb && pa <= pc ? a : pb <= pc ? b : c;
      }
      data[to + x] = rows[from + x] + guess;
    }
  }
  return data;
}
