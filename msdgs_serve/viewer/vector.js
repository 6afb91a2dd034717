// Vectors of three numbers.

export const add = (a, b, scale = 1) => a.map((x, i) => x + scale * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(...a);
export const scaled = (a, scale) => a.map((x) => x * scale);
export const unit = (a) => scaled(a, 1 / length(a));
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
