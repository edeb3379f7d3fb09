// The image: the same mathematics as the project's rasterizer (elliptical weighted average projection, the blur of
// 0.3 pixels squared, alpha at most .99, nothing below 1/255), drawn from the farthest Gaussian to the nearest.
"use strict";

const HARMONICS = `// The sixteen spherical harmonics of a direction, in the order and with the signs of 3DGS.
void harmonics(vec3 d, out float values[16]) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  values[0] = 0.28209479177387814;
  values[1] = -0.4886025119029199 * y;
  values[2] = 0.4886025119029199 * z;
  values[3] = -0.4886025119029199 * x;
  values[4] = 1.0925484305920792 * x * y;
  values[5] = -1.0925484305920792 * y * z;
  values[6] = 0.31539156525252005 * (2. * zz - xx - yy);
  values[7] = -1.0925484305920792 * x * z;
  values[8] = 0.5462742152960396 * (xx - yy);
  values[9] = -0.5900435899266435 * y * (3. * xx - yy);
  values[10] = 2.890611442640554 * x * y * z;
  values[11] = -0.4570457994644658 * y * (4. * zz - xx - yy);
  values[12] = 0.3731763325901154 * z * (2. * zz - 3. * xx - 3. * yy);
  values[13] = -0.4570457994644658 * x * (4. * zz - xx - yy);
  values[14] = 1.445305721320277 * z * (xx - yy);
  values[15] = -0.5900435899266435 * x * (xx - 3. * yy);
}`;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order;
uniform sampler2D stateFrom, stateTo, motion, colors;
uniform float share, time, duration, cut;
uniform bool lines, asDepth;
uniform mat3 rotation;
uniform vec3 translation, centre;
uniform vec2 focal, principal, size;
uniform float near, blur, alphaMin, fovClamp, depthUnit;
uniform int degree, timeDegree;

flat out vec2 center;
flat out vec3 conic;       // (ux, uy, vy): exponent of 2 is -(ux dx + uy dy)^2 - (vy dy)^2
flat out vec4 paint;       // colour, or depth, and log2 of the opacity

const float LN_2 = 0.693147180559945, HALF_EXPONENT = 0.849321800288019;

vec4 texel(sampler2D source, int index) { return texelFetch(source, ivec2(index & 4095, index >> 12), 0); }

${HARMONICS}

vec3 seenColor(vec3 direction, int first, float phase) {
  if (degree == 0 && timeDegree == 0) return max(0.5 + 0.28209479177387814 * texel(colors, first).rgb, 0.);
  float values[16];
  harmonics(direction, values);
  int count = (degree + 1) * (degree + 1);
  vec3 color = vec3(0.5);
  for (int wave = 0; wave <= timeDegree; wave++) {
    float strength = cos(6.283185307179586 * float(wave) * phase);
    for (int k = 0; k < count; k++) color += strength * values[k] * texel(colors, first + wave * count + k).rgb;
  }
  return max(color, 0.);
}

void main() {
  gl_Position = vec4(2., 2., 2., 1.);  // outside of the image
  int place = gl_VertexID >> 2;
  int i = int(texelFetch(order, ivec2(place & 4095, place >> 12), 0).r);
  vec4 a = mix(texel(stateFrom, 3 * i), texel(stateTo, 3 * i), share);
  vec4 b = mix(texel(stateFrom, 3 * i + 1), texel(stateTo, 3 * i + 1), share);
  vec4 c = mix(texel(stateFrom, 3 * i + 2), texel(stateTo, 3 * i + 2), share);
  vec3 mean = a.xyz;
  float opacity = a.w, phase = 0.;
  if (lines) {
    vec4 v = texel(motion, 2 * i), t = texel(motion, 2 * i + 1);  // velocity and anchor; mean time and sigma
    float late = (time - t.x) / t.y, factor = exp(-0.5 * late * late);
    if (factor <= cut) return;
    opacity *= factor;
    mean += v.xyz * (time - v.w);
    phase = (time - t.x) / duration;
  }
  vec3 point = rotation * mean + translation;
  if (point.z <= near || opacity < alphaMin) return;

  // The linearisation explodes beside the camera: slopes are clamped around the middle of the image.
  vec2 middle = (0.5 * size - principal) / focal, halfway = fovClamp * 0.5 * size / focal;
  vec2 slopes = clamp(point.xy / point.z, middle - halfway, middle + halfway);
  mat3 turned = transpose(rotation);  // its columns are the rows of the rotation
  vec3 rowX = focal.x / point.z * (turned[0] - slopes.x * turned[2]);
  vec3 rowY = focal.y / point.z * (turned[1] - slopes.y * turned[2]);
  // The covariance is L L^T with L from its six entries: project the factor, never the matrix.
  mat3 factorT = mat3(b.x, 0., 0., b.y, b.w, 0., b.z, c.x, c.y);
  vec3 alongX = factorT * rowX, alongY = factorT * rowY;
  float floorVariance = max(blur, 1e-8);
  float varianceX = dot(alongX, alongX) + floorVariance, varianceY = dot(alongY, alongY) + floorVariance;
  float covariance = dot(alongX, alongY), slope = covariance / varianceY;
  float given = max(varianceX - slope * covariance, floorVariance);

  float ux = HALF_EXPONENT * inversesqrt(given);
  conic = vec3(ux, -slope * ux, HALF_EXPONENT * inversesqrt(varianceY));
  center = point.xy / point.z * focal + principal;
  float log2Opacity = log2(max(opacity, 1e-30));

  // The rectangle along the axes of the ellipse outside of which alpha is below alphaMin.
  float mean2 = 0.5 * (varianceX + varianceY), difference = 0.5 * (varianceX - varianceY);
  float radius = length(vec2(difference, covariance));
  vec2 axis = abs(covariance) > 1e-6 * mean2 ? normalize(vec2(covariance, radius - difference))
                                             : (difference >= 0. ? vec2(1., 0.) : vec2(0., 1.));
  float reach = 1.001 * sqrt(2. * LN_2 * max(log2Opacity - log2(alphaMin), 0.));
  vec2 corner = vec2(float(gl_VertexID & 1), float((gl_VertexID >> 1) & 1)) * 2. - 1.;
  vec2 along = axis * sqrt(mean2 + radius) * corner.x;
  vec2 across = vec2(-axis.y, axis.x) * sqrt(max(mean2 - radius, floorVariance)) * corner.y;
  vec2 pixel = center + reach * (along + across);
  gl_Position = vec4(2. * pixel.x / size.x - 1., 1. - 2. * pixel.y / size.y, 0., 1.);

  int coefficients = (degree + 1) * (degree + 1) * (timeDegree + 1);
  vec3 color = asDepth ? vec3(point.z / depthUnit) : seenColor(normalize(mean - centre), coefficients * i, phase);
  paint = vec4(color, log2Opacity);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
uniform vec2 size;
uniform float alphaMax, alphaMin;
flat in vec2 center;
flat in vec3 conic;
flat in vec4 paint;
out vec4 result;
void main() {
  vec2 d = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - center;
  float u = conic.x * d.x + conic.y * d.y, v = conic.z * d.y;
  float alpha = exp2(paint.w - u * u - v * v);
  if (!(alpha >= alphaMin)) discard;
  alpha = min(alpha, alphaMax);
  result = vec4(paint.rgb * alpha, alpha);
}`;

const FINISH_VERTEX = `#version 300 es
void main() { gl_Position = vec4(float(gl_VertexID & 1) * 4. - 1., float(gl_VertexID >> 1) * 4. - 1., 0., 1.); }`;

const FINISH_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D sums, palette, photo;
uniform int mode;              // 0 colour, 1 depth, 2 opacity, 3 the recorded image
uniform vec2 size, focal, principal, depthRange, photoSize;
uniform mat3 rotation;
uniform float depthUnit, photoScale;
uniform bool hasSky;
uniform vec3 sky[16];
out vec4 result;

${HARMONICS}

vec3 behind(vec2 pixel) {
  float values[16];
  harmonics(normalize(transpose(rotation) * vec3((pixel - principal) / focal, 1.)), values);
  vec3 color = vec3(0.5);
  for (int k = 0; k < 16; k++) color += values[k] * sky[k];
  return clamp(color, 0., 1.);
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  if (mode == 3) {  // whose middle is that of the image
    result = vec4(texture(photo, 0.5 + (pixel - 0.5 * size) / (photoScale * photoSize)).rgb, 1.);
    return;
  }
  vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
  vec3 color = sum.rgb;
  if (mode == 0 && hasSky && sum.a < 0.999) color += (1. - sum.a) * behind(pixel);
  if (mode == 1) {
    float depth = sum.r / max(sum.a, 1e-4) * depthUnit;
    float place = clamp((depth - depthRange.x) / max(depthRange.y - depthRange.x, 1e-12), 0., 1.);
    color = texelFetch(palette, ivec2(int(place * 255. + 0.5), 0), 0).rgb * sum.a;
  }
  if (mode == 2) color = vec3(sum.a);
  result = vec4(clamp(color, 0., 1.), 1.);
}`;
