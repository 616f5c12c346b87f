// Reads what heatsplat.viewer.payload wrote: a header, and arrays that it says the place of.

const ARRAYS = { f4: Float32Array, f8: Float64Array, i2: Int16Array, i1: Int8Array, u2: Uint16Array, u1: Uint8Array };

async function inflated(base64) {
  const text = atob(base64.trim());
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

// The payload of a page: this one, or another run's that was parsed from its file.
async function readPayload(page) {
  const header = page.getElementById("header");
  const block = page.getElementById("block");
  if (!header || !block) throw new Error("this is no viewer.html of heatsplat");
  const told = JSON.parse(header.textContent);
  if (told.format !== 3) throw new Error("this viewer.html was written by another version of heatsplat");
  const bytes = await inflated(block.textContent);
  const array = (place) => {
    const count = place.shape.reduce((a, b) => a * b, 1);
    return new ARRAYS[place.type](bytes, place.offset, count);
  };
  return { told, array };
}
