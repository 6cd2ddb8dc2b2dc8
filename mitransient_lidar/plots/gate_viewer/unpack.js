"use strict";

const byId = (id) => document.getElementById(id);

/** Decode base64 piece by piece, without a string of the full size. */
function decodeBase64(text) {
  const piece = 1 << 20; // a multiple of 4 letters
  const parts = [];
  for (let start = 0; start < text.length; start += piece) {
    const letters = atob(text.slice(start, start + piece));
    const bytes = new Uint8Array(letters.length);
    for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
    parts.push(bytes);
  }
  return parts;
}

/** Return a response with the inflated data of an element of base64, which is removed. */
function unpacked(id) {
  const element = byId(id);
  const packed = new Blob(decodeBase64(element.textContent)).stream();
  element.remove();
  return new Response(packed.pipeThrough(new DecompressionStream("deflate-raw")));
}
