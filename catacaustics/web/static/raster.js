// Masks as arrays of 0 and 1, row by row. Pixel centres are at +0.5, as everywhere in catacaustics.

// Lengths of runs of equal pixels; the first run is of zeros and may be 0.
export function encodeRuns(mask) {
  const runs = [];
  let value = 0;
  let start = 0;
  for (;;) {
    const end = mask.indexOf(1 - value, start);
    runs.push((end < 0 ? mask.length : end) - start);
    if (end < 0) return runs;
    value = 1 - value;
    start = end;
  }
}

export function decodeRuns(runs, size) {
  const mask = new Uint8Array(size);
  let at = 0;
  runs.forEach((length, i) => {
    if (i % 2) mask.fill(1, at, at + length);
    at += length;
  });
  return mask;
}

export const isEmpty = (runs) => runs.length < 2;

export function sameRuns(a, b) {
  return a.length === b.length && a.every((length, i) => length === b[i]);
}

// Share of pixels that are white.
export function coverage(runs) {
  let white = 0;
  let all = 0;
  runs.forEach((length, i) => {
    all += length;
    if (i % 2) white += length;
  });
  return white / all;
}

function clip(width, height, x0, y0, x1, y1) {
  const rect = { x0: Math.max(Math.floor(x0), 0), y0: Math.max(Math.floor(y0), 0) };
  rect.x1 = Math.min(Math.ceil(x1), width);
  rect.y1 = Math.min(Math.ceil(y1), height);
  return rect.x0 < rect.x1 && rect.y0 < rect.y1 ? rect : null;
}

// Set the pixels within `radius` of a line segment; returns the rectangle that may have changed, or null.
export function paintSegment(mask, width, height, from, to, radius, value) {
  const reach = Math.max(radius, 0.71);
  const rect = clip(width, height, Math.min(from.x, to.x) - reach, Math.min(from.y, to.y) - reach,
    Math.max(from.x, to.x) + reach, Math.max(from.y, to.y) + reach);
  if (!rect) return null;
  const dx = to.x - from.x;
  const dy = to.y - from.y;
  const squared = dx * dx + dy * dy;
  for (let y = rect.y0; y < rect.y1; y++) {
    for (let x = rect.x0; x < rect.x1; x++) {
      const px = x + 0.5 - from.x;
      const py = y + 0.5 - from.y;
      const t = squared ? Math.min(Math.max((px * dx + py * dy) / squared, 0), 1) : 0;
      if ((px - t * dx) ** 2 + (py - t * dy) ** 2 <= reach * reach) mask[y * width + x] = value;
    }
  }
  return rect;
}

// Set the pixels whose centres lie inside a polygon (even-odd rule); returns the rectangle that may have changed, or null.
export function fillPolygon(mask, width, height, points, value) {
  const xs = points.map((p) => p.x);
  const ys = points.map((p) => p.y);
  const rect = clip(width, height, Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys));
  if (!rect) return null;
  for (let y = rect.y0; y < rect.y1; y++) {
    const crossings = [];
    points.forEach((a, i) => {
      const b = points[(i + 1) % points.length];
      if ((a.y <= y + 0.5) !== (b.y <= y + 0.5)) crossings.push(a.x + ((y + 0.5 - a.y) / (b.y - a.y)) * (b.x - a.x));
    });
    crossings.sort((a, b) => a - b);
    for (let i = 0; i + 1 < crossings.length; i += 2) {
      const start = Math.max(Math.ceil(crossings[i] - 0.5), 0);
      const end = Math.min(Math.ceil(crossings[i + 1] - 0.5), width);
      if (start < end) mask.fill(value, y * width + start, y * width + end);
    }
  }
  return rect;
}

export function parseColor(color) {
  return [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16));
}

// Colour a mask into ImageData of the rectangle: a translucent fill with an opaque rim.
export function tint(mask, width, height, rect, color, data) {
  const [red, green, blue] = parseColor(color);
  let at = 0;
  for (let y = rect.y0; y < rect.y1; y++) {
    for (let x = rect.x0; x < rect.x1; x++, at += 4) {
      const i = y * width + x;
      if (!mask[i]) {
        data[at + 3] = 0;
        continue;
      }
      const inner = (x === 0 || mask[i - 1]) && (x === width - 1 || mask[i + 1])
        && (y === 0 || mask[i - width]) && (y === height - 1 || mask[i + width]);
      data[at] = red;
      data[at + 1] = green;
      data[at + 2] = blue;
      data[at + 3] = inner ? 96 : 255;
    }
  }
}
