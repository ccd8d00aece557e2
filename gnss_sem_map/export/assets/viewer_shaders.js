"use strict";
// The two passes of the viewer. First, every voxel is a point sprite in which the fragment shader meets the exact
// cube; then hollows are darkened (eye-dome lighting). Lengths are in voxels, x east, y north, z up.

const NEAR = 1, FAR = 2e7, LINE_HALF = 0.3, INFERRED = 2, REMOVED = 4;
const WHITE_OF_INFERRED = 0.35;  // as in the pictures

const VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 cell;
layout(location = 1) in uvec4 about;  // class, confidence, origin
uniform mat3 axes;                    // columns: right, up, forward
uniform vec3 corner;                  // of the node, from the eye
uniform vec2 size;
uniform float focal, largest, scale, eyeHeight, leastConfidence;
uniform uint before;                  // voxels of the nodes that were drawn before
uniform vec4 palette[70];             // rgb and whether it is shown
uniform vec3 ramp[5], origins[6];
uniform vec2 heights;
uniform int mode, firstLine;
uniform bool removed;
flat out vec3 centre, colour;
flat out float extent, ahead, pixels;
flat out uint number;
vec3 ramped(float t) {
  float s = clamp(t, 0.0, 1.0) * 4.0;
  int i = min(int(s), 3);
  return mix(ramp[i], ramp[i + 1], s - float(i));
}
void main() {
  bool bead = int(about.x) >= firstLine;
  bool unlabelled = !bead && (int(about.x) == firstLine - 1 || float(about.y) < 255.0 * leastConfidence - 0.01);
  vec4 entry = palette[unlabelled ? firstLine - 1 : int(about.x)];
  centre = (cell + 0.5) * scale + corner;
  vec3 seen = centre * axes;
  extent = bead ? ${LINE_HALF} : 0.5 * scale;
  ahead = seen.z;
  number = before + uint(gl_VertexID) + 1u;
  bool gone = about.z == ${REMOVED}u;
  if (ahead < ${NEAR}.0 || entry.a < 0.5 || (gone && !removed)) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  colour = bead || mode == 0 || (unlabelled && mode == 2) ? entry.rgb
         : mode == 1 ? ramped((centre.z + eyeHeight - heights.x) / (heights.y - heights.x))
         : mode == 2 ? ramped(float(about.y) / 255.0) : origins[about.z];
  if (mode == 0 && !unlabelled && about.z == ${INFERRED}u) colour = mix(colour, vec3(1.0), ${WHITE_OF_INFERRED});
  if (gone) colour = origins[${REMOVED}];
  pixels = 3.4641 * extent * focal / ahead;
  gl_PointSize = clamp(pixels * 1.1 + 1.0, 1.5, largest);
  gl_Position = vec4(2.0 * focal * seen.xy / size, 0.0, ahead);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform mat3 axes;
uniform vec2 size;
uniform float focal;
flat in vec3 centre, colour;
flat in float extent, ahead, pixels;
flat in uint number;
layout(location = 0) out vec4 painted;
layout(location = 1) out uint voxel;
void main() {
  float depth = ahead, light = 0.82;
  if (pixels > 3.0) {  // a ray with forward component 1 against the cube
    vec3 ray = axes * vec3((gl_FragCoord.xy - 0.5 * size) / focal, 1.0);
    vec3 a = (centre - extent) / ray, b = (centre + extent) / ray;
    vec3 enter = min(a, b), leave = max(a, b);
    depth = max(enter.x, max(enter.y, enter.z));
    if (depth > min(leave.x, min(leave.y, leave.z)) || depth < 0.0) discard;
    float face = depth == enter.z ? 1.0 : depth == enter.x ? 0.8 : 0.68;
    light = mix(light, face, clamp((pixels - 3.0) / 3.0, 0.0, 1.0));
  }
  painted = vec4(colour * light, 1.0);
  voxel = number;
  gl_FragDepth = log(max(depth, ${NEAR}.0)) / log(${FAR}.0);
}`;

const SCREEN = `#version 300 es
void main() { gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 4.0 * float(gl_VertexID >> 1) - 1.0, 0.0, 1.0); }`;

const LIGHTING = `#version 300 es
precision highp float;
uniform highp sampler2D paint, depths;
uniform vec2 size;
out vec4 shown;
float depthAt(ivec2 p) { return texelFetch(depths, clamp(p, ivec2(0), ivec2(size) - 1), 0).x * log(${FAR}.0); }
float hollow(ivec2 p, float here, int reach, float most) {
  vec4 near = vec4(depthAt(p + ivec2(reach, 0)), depthAt(p - ivec2(reach, 0)),
                   depthAt(p + ivec2(0, reach)), depthAt(p - ivec2(0, reach)));
  return dot(clamp(here - near, 0.0, most), vec4(0.25));
}
void main() {
  ivec2 p = ivec2(gl_FragCoord.xy);
  float here = depthAt(p);
  vec3 sky = mix(vec3(0.15, 0.19, 0.26), vec3(0.05, 0.067, 0.11), gl_FragCoord.y / size.y);
  float dark = 6.0 * hollow(p, here, 1, 0.1) + 2.5 * hollow(p, here, 4, 0.15) + 1.5 * hollow(p, here, 16, 0.25);
  bool empty = here > 0.999 * log(${FAR}.0);
  shown = vec4(empty ? sky : texelFetch(paint, p, 0).rgb * exp(-dark), 1.0);
}`;
