// The two stages of msdgs_serve/rasterizer in GLSL: Gaussians to splats, and splats to pixels.

export const ROW_BITS = 12; // 2^12 texels in a row of a texture

/** What doesn't depend on time, and what does in all moving scenes. */
export const STILL = ["means", "quats", "scales", "opacities", "sh"];
export const MOVING = ["means", "quats", "scales"];

/** Samplers of `projectShader` in the order of their texture units; of poses the earlier and the later one. */
export const samplersOf = (posed) => ["order", ...STILL, ...posed.flatMap((name) => [`${name}A`, `${name}B`])];

export const NEAR_PLANE = 0.01; // scene units

/** The color that is 1 in the frame: colors of splats, and so those behind others, may be above what is shown. */
export const BRIGHTEST = "2.0";

const ALPHA_MIN = "(1.0 / 255.0)";
const ALPHA_MAX = "0.999";

/** A triangle over all of a target. */
export const EVERYWHERE = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

/** The fragment shader of a pass that projects Gaussians: one splat per texel, in the order in which they are blended.
 * `posed`: what depends on time. */
export function projectShader({ degree, posed }) {
  const changes = (name) => posed.includes(name);
  return `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform highp usampler2D order;
${samplersOf(posed).slice(1).map((name) => `uniform sampler2D ${name};`).join("\n")}
uniform int found; // Gaussians in the order
uniform int moving; // Gaussians, which come first
uniform float share; // of the way from pose A to pose B
uniform mat3 rotation; // world to camera
uniform vec3 eye;
uniform vec2 focal, principal, size; // pixels
uniform vec4 limits; // of x/z and y/z in the Jacobian: low x, low y, high x, high y
uniform float eps2d;
uniform bool mip;
uniform int channel; // 0: color, 1: alpha, 2: depth
uniform vec2 depths; // of the depth channel: nearest, farthest
// Of the ellipse outside of which alpha is below the cut-off: its center and its longer half-axis, in pixels.
layout(location = 0) out uvec4 placed;
// The ratio of its half-axes, 0 if it isn't drawn; the color as halves; log2 of the opacity.
layout(location = 1) out uvec4 painted;

vec4 at(sampler2D texture_, int k) {
  return texelFetch(texture_, ivec2(k & ${(1 << ROW_BITS) - 1}, k >> ${ROW_BITS}), 0);
}

vec3 coefficient(int i, int k) {
  k += ${(degree + 1) ** 2} * ${changes("sh") ? "(i < moving ? i : i - moving)" : "i"};
  ${changes("sh") ? "if (i < moving) return mix(at(shA, k).rgb, at(shB, k).rgb, share);" : ""}
  return at(sh, k).rgb;
}

float opacityOf(int i) {
  ${
    changes("opacities")
      ? "return i < moving ? mix(at(opacitiesA, i).r, at(opacitiesB, i).r, share) : at(opacities, i - moving).r;"
      : "return at(opacities, i).r;"
  }
}

vec3 seenColor(int i, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 c = 0.5 + 0.28209479177387814 * coefficient(i, 0);
${harmonics(degree)}
  return max(c, 0.0);
}

void main() {
  placed = painted = uvec4(0u);
  ivec2 texel = ivec2(gl_FragCoord.xy);
  if (texel.x + (texel.y << ${ROW_BITS}) >= found) return;
  int i = int(texelFetch(order, texel, 0).r), k = i - moving;
  vec3 mean, sizes;
  vec4 q;
  if (i < moving) {
    mean = mix(at(meansA, i).xyz, at(meansB, i).xyz, share);
    sizes = mix(at(scalesA, i).xyz, at(scalesB, i).xyz, share);
    vec4 before = at(quatsA, i), after = at(quatsB, i);
    q = normalize(mix(before, dot(before, after) < 0.0 ? -after : after, share));
  } else {
    mean = at(means, k).xyz;
    sizes = at(scales, k).xyz;
    q = at(quats, k);
  }
  float opacity = opacityOf(i);

  vec3 p = rotation * (mean - eye);
  if (p.z <= ${NEAR_PLANE} || opacity < ${ALPHA_MIN}) return;
  vec2 ratio = p.xy / p.z, perPixel = focal / p.z;
  vec2 center = ratio * focal + principal;
  vec2 sheared = -perPixel * clamp(ratio, limits.xy, limits.zw);
  mat3x2 jacobian = mat3x2(perPixel.x, 0.0, 0.0, perPixel.y, sheared);

  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 turned = rotation * mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
  );
  vec2 a = jacobian * turned[0] * sizes.x, b = jacobian * turned[1] * sizes.y, c = jacobian * turned[2] * sizes.z;
  float xx = a.x * a.x + b.x * b.x + c.x * c.x, yy = a.y * a.y + b.y * b.y + c.y * c.y;
  float xy = a.x * a.y + b.x * b.y + c.x * c.y;
  // a sum of squares, so that needles lose no digits
  vec3 minors = vec3(b.x * c.y - b.y * c.x, c.x * a.y - c.y * a.x, a.x * b.y - a.y * b.x);
  float sharp = dot(minors, minors);
  float det = sharp + eps2d * (xx + yy) + eps2d * eps2d;
  xx += eps2d;
  yy += eps2d;
  if (mip) opacity *= sqrt(sharp / det);
  if (!(det > 0.0) || opacity < ${ALPHA_MIN}) return;

  float reach = 2.0 * log(255.0 * opacity);
  vec2 extent = sqrt(reach * vec2(xx, yy));
  if (any(lessThan(center + extent, vec2(0.0))) || any(greaterThan(center - extent, size))) return;

  float half_ = 0.5 * (xx - yy), radius = length(vec2(half_, xy)), large = 0.5 * (xx + yy) + radius;
  vec2 along = half_ > 0.0 ? vec2(radius + half_, xy) : vec2(xy, radius - half_);
  along = radius > 0.0 ? normalize(along) : vec2(1.0, 0.0);
  vec2 major = sqrt(reach * large) * along;
  vec3 color = vec3(1.0);
  if (channel == 0) color = seenColor(i, normalize(mean - eye));
  else if (channel == 2) color -= 0.85 * clamp((p.z - depths.x) / (depths.y - depths.x), 0.0, 1.0);
  placed = floatBitsToUint(vec4(center, major));
  float ratio_ = sqrt(det) / large;
  painted = uvec4(
    floatBitsToUint(ratio_), packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0.0)), floatBitsToUint(log2(opacity))
  );
}`;
}

function harmonics(degree) {
  const bands = [
    `  c += 0.4886025119029199 * (z * coefficient(i, 2) - y * coefficient(i, 1) - x * coefficient(i, 3));`,
    `  c += 1.0925484305920792 * (x * y * coefficient(i, 4) - y * z * coefficient(i, 5) - x * z * coefficient(i, 7))
    + 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(i, 6)
    + 0.5462742152960396 * (xx - yy) * coefficient(i, 8);`,
    `  c += -0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(i, 9) + x * (xx - 3.0 * yy) * coefficient(i, 15))
    + 2.890611442640554 * x * y * z * coefficient(i, 10)
    - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(i, 11) + x * coefficient(i, 13))
    + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(i, 12)
    + 1.445305721320277 * z * (xx - yy) * coefficient(i, 14);`,
  ];
  return bands.slice(0, degree).join("\n");
}

/** A triangle around the ellipse of each splat: with a third more pixels than a quad it takes 0.85 times as long. */
export const BLEND_VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D placed, painted;
uniform vec2 size;
out vec2 place; // 1 at the edge of the ellipse
flat out vec4 splat; // color, and log2 of the opacity
const vec2 CORNERS[3] = vec2[3](vec2(0.0, 2.0), vec2(-sqrt(3.0), -1.0), vec2(sqrt(3.0), -1.0));
void main() {
  int k = gl_VertexID / 3;
  place = CORNERS[gl_VertexID - 3 * k];
  splat = gl_Position = vec4(0.0); // all corners at one point
  ivec2 texel = ivec2(k & ${(1 << ROW_BITS) - 1}, k >> ${ROW_BITS});
  uvec4 b = texelFetch(painted, texel, 0);
  if (b.x == 0u) return;
  vec4 a = uintBitsToFloat(texelFetch(placed, texel, 0));
  splat = vec4(unpackHalf2x16(b.y), unpackHalf2x16(b.z).x, uintBitsToFloat(b.w));
  vec2 minor = uintBitsToFloat(b.x) * vec2(-a.w, a.z);
  vec2 pixel = (a.xy + place.x * a.zw + place.y * minor) / size;
  gl_Position = vec4(pixel.x * 2.0 - 1.0, 1.0 - pixel.y * 2.0, 0.0, 1.0);
}`;

export const BLEND_FRAGMENT = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 splat;
out vec4 pixel; // premultiplied
void main() {
  float square = dot(place, place);
  if (square > 1.0) discard;
  float alpha = min(exp2(mix(splat.a, LOG2_ALPHA_MIN, square)), ${ALPHA_MAX});
  pixel = vec4(splat.rgb * (alpha / ${BRIGHTEST}), alpha);
}`.replace("LOG2_ALPHA_MIN", -Math.log2(255));

/** The frame, for the canvas. */
export const RESOLVE = `#version 300 es
precision highp float;
uniform sampler2D frame;
out vec4 pixel;
void main() {
  pixel = vec4(texelFetch(frame, ivec2(gl_FragCoord.xy), 0).rgb * ${BRIGHTEST}, 1.0);
}`;
