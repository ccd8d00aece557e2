"use strict";
// Unpacks the voxels of this page, draws them when something has changed, and listens to mouse and touch.
// Lengths are in voxels, x east, y north, z up.

const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const ORIGINS = ["not seen by a camera", "seen", "inferred", "refined", "removed"];
const ORIGIN_COLOURS = [[150, 150, 150], [90, 150, 255], [255, 170, 60], [90, 210, 120], [240, 60, 60]];

const meta = JSON.parse(document.getElementById("meta").textContent);
const canvas = document.querySelector("canvas");
const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
const hash = new URLSearchParams(location.hash.slice(1));  // #colour=height&hide=building,vegetation
const classes = meta.classes.length;  // then one entry for unlabelled and one for the track
const layers = [...meta.classes, { name: "unlabelled", colour: [150, 150, 150], count: meta.unlabelled },
                { name: "track", colour: [255, 214, 10], count: meta.track.length }];
const hidden = new Set((hash.get("hide") ?? (meta.classes.some(c => c.count) ? "unlabelled" : "")).split(","));
const visible = layers.map(layer => !hidden.has(layer.name));
let showRemoved = hash.has("removed"), mode = 0, frameAsked = false;
const camera = { azimuth: -0.6, elevation: 0.65, distance: meta.view.distance, target: [...meta.view.target] };

async function inflate() {
  const packed = Uint8Array.from(atob(document.getElementById("voxels").textContent), c => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Planes of n bytes: for x, y and z the low, middle and high byte of the zigzag difference to the voxel before, then
// class, confidence and origin. The beads of the track follow the voxels.
function decode(bytes, beads) {
  const n = meta.count, total = n + beads.length;
  const cells = new Float32Array(3 * total), about = new Uint8Array(4 * total);
  let at = 0;
  const plane = () => bytes.subarray(at, at += n);
  for (let axis = 0; axis < 3; axis++) {
    const low = plane(), middle = plane(), high = plane();
    for (let i = 0, value = 0; i < n; i++) {
      const zigzag = low[i] | middle[i] << 8 | high[i] << 16;
      cells[3 * i + axis] = (value += (zigzag >>> 1) ^ -(zigzag & 1)) + 0.5;
    }
  }
  for (let k = 0; k < 3; k++) plane().forEach((value, i) => { about[4 * i + k] = value; });
  beads.forEach((bead, i) => { cells.set(bead, 3 * (n + i)); about[4 * (n + i)] = classes + 1; });
  return { cells, about, total };
}

function beadsOf(track) {
  const beads = [];
  for (let i = 1; i < track.length; i++) {
    const [a, b] = [track[i - 1], track[i]];
    const steps = Math.ceil(Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]) / TRACK_HALF);
    for (let s = 0; s < steps; s++) beads.push(a.map((v, k) => v + (b[k] - v) * s / steps));
  }
  return beads;
}

function program(vertex, fragment) {
  const linked = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  return { linked, at: name => gl.getUniformLocation(linked, name) };
}

function texture(internal, format, kind) {
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, canvas.width, canvas.height, 0, format, kind, null);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  return gl.getParameter(gl.TEXTURE_BINDING_2D);
}

let target = null;
function fitTarget() {
  const scale = Math.min(devicePixelRatio || 1, 2);
  const [width, height] = [Math.max(1, Math.round(innerWidth * scale)), Math.max(1, Math.round(innerHeight * scale))];
  if (target && canvas.width === width && canvas.height === height) return;
  Object.assign(canvas, { width, height });
  if (target) [target.paint, target.voxel, target.depth].forEach(t => gl.deleteTexture(t));
  target = { buffer: target?.buffer ?? gl.createFramebuffer(),
             paint: texture(gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE),
             voxel: texture(gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT),
             depth: texture(gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT) };
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  [[gl.COLOR_ATTACHMENT0, target.paint], [gl.COLOR_ATTACHMENT1, target.voxel], [gl.DEPTH_ATTACHMENT, target.depth]]
    .forEach(([place, t]) => gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, t, 0));
  gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
}

function axesOf({ azimuth, elevation }) {
  const [sa, ca, se, ce] = [Math.sin(azimuth), Math.cos(azimuth), Math.sin(elevation), Math.cos(elevation)];
  return { right: [ca, -sa, 0], up: [sa * se, ca * se, ce], forward: [sa * ce, ca * ce, -se] };
}

let scene = null;
function draw() {
  frameAsked = false;
  fitTarget();
  const { right, up, forward } = axesOf(camera), { voxels, lighting } = scene;
  const eye = camera.target.map((t, k) => t - camera.distance * forward[k]);
  const palette = layers.flatMap((layer, i) => [...layer.colour.map(c => c / 255), visible[i] ? 1 : 0]);
  const flat = colours => colours.flat().map(c => c / 255);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.enable(gl.DEPTH_TEST);
  gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
  gl.clearBufferuiv(gl.COLOR, 1, [0, 0, 0, 0]);
  gl.clearBufferfv(gl.DEPTH, 0, [1]);
  gl.useProgram(voxels.linked);
  gl.uniformMatrix3fv(voxels.at("axes"), false, [...right, ...up, ...forward]);
  gl.uniform3fv(voxels.at("eye"), eye);
  gl.uniform2f(voxels.at("size"), canvas.width, canvas.height);
  gl.uniform1f(voxels.at("focal"), 0.9 * canvas.height);
  gl.uniform1f(voxels.at("largest"), gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE)[1]);
  gl.uniform4fv(voxels.at("palette"), palette);
  gl.uniform3fv(voxels.at("ramp"), flat(RAMP));
  gl.uniform3fv(voxels.at("origins"), flat(ORIGIN_COLOURS));
  gl.uniform2fv(voxels.at("heights"), meta.heights);
  gl.uniform1i(voxels.at("mode"), mode);
  gl.uniform1i(voxels.at("track"), classes + 1);
  gl.uniform1i(voxels.at("removed"), showRemoved ? 1 : 0);
  gl.drawArrays(gl.POINTS, 0, scene.total);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.disable(gl.DEPTH_TEST);
  gl.useProgram(lighting.linked);
  [["paint", target.paint], ["depths", target.depth]].forEach(([name, t], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, t);
    gl.uniform1i(lighting.at(name), unit);
  });
  gl.uniform2f(lighting.at("size"), canvas.width, canvas.height);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

function redraw() {
  if (!frameAsked) frameAsked = requestAnimationFrame(draw);
}

function pick(event) {
  const scale = canvas.width / innerWidth, found = new Uint32Array(4);
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target.buffer);
  gl.readBuffer(gl.COLOR_ATTACHMENT1);
  gl.readPixels(event.clientX * scale, canvas.height - 1 - event.clientY * scale, 1, 1,
                gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
  const i = found[0] - 1, [label, confidence, origin] = scene.about.subarray(4 * i, 4 * i + 3);
  const metres = [...scene.cells.subarray(3 * i, 3 * i + 3)]
    .map((v, k) => ((v + meta.origin[k]) * meta.voxel_m).toFixed(1));
  const place = `east ${metres[0]} m, north ${metres[1]} m, up ${metres[2]} m`;
  const what = label > classes ? "track" : `${layers[label]?.name}, ${ORIGINS[origin]}`
    + (label < classes ? `, probability ${(confidence / 255).toFixed(2)}` : "");
  document.getElementById("picked").textContent = i < 0 ? "" : `${what}\n${place}`;
}

function zoom(factor) {
  camera.distance = Math.min(FAR / 10, Math.max(5, camera.distance * factor));
  redraw();
}

function listen() {
  const pointers = new Map();
  const apart = () => {
    const [a, b] = [...pointers.values()];
    return b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 1;
  };
  let moved = 0;
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    moved = 0;
  });
  canvas.addEventListener("pointermove", event => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const apartBefore = apart();
    pointers.set(event.pointerId, event);
    zoom(apartBefore / apart());
    moved += Math.abs(dx) + Math.abs(dy);
    if (event.buttons & 2 || event.shiftKey || pointers.size > 1) {
      const { right, forward } = axesOf(camera), step = camera.distance / (0.9 * innerHeight);
      const level = Math.hypot(forward[0], forward[1]);
      camera.target[0] += step * (-dx * right[0] + dy * forward[0] / level);
      camera.target[1] += step * (-dx * right[1] + dy * forward[1] / level);
    } else {
      camera.azimuth += 0.006 * dx;
      camera.elevation = Math.min(1.55, Math.max(0.02, camera.elevation + 0.006 * dy));
    }
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => {
    pointers.delete(event.pointerId);
    if (name === "pointerup" && moved < 4) pick(event);
  });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  addEventListener("resize", redraw);
}

function addLayer(name, colour, count, checked, change) {
  const row = document.createElement("label"), box = document.createElement("input");
  const patch = document.createElement("i"), number = document.createElement("b");
  Object.assign(box, { type: "checkbox", checked, onchange: () => { change(box.checked); redraw(); } });
  patch.style.background = `rgb(${colour})`;
  number.textContent = count.toLocaleString("en");
  row.append(box, patch, name, number);
  document.getElementById("layers").append(row);
}

function colourBy(name) {
  const select = document.querySelector("select"), ramp = document.getElementById("ramp");
  select.value = name;
  mode = Math.max(0, select.selectedIndex);
  const ends = mode === 1 ? meta.heights.map(h => `${((h + meta.origin[2]) * meta.voxel_m).toFixed(1)} m`) : ["0", "1"];
  [...ramp.children].forEach((end, i) => { end.textContent = ends[i]; });
  ramp.style.display = mode === 1 || mode === 2 ? "flex" : "none";
  ramp.style.background = `linear-gradient(90deg, ${RAMP.map(c => `rgb(${c})`)})`;
}

async function main() {
  if (!gl) throw new Error("this browser has no WebGL 2");
  const { cells, about, total } = decode(await inflate(), beadsOf(meta.track));
  [[cells, 3, false], [about, 4, true]].forEach(([data, width, whole], place) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    if (whole) gl.vertexAttribIPointer(place, width, gl.UNSIGNED_BYTE, 0, 0);
    else gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
  });
  scene = { cells, about, total, voxels: program(VERTEX, FRAGMENT), lighting: program(SCREEN, LIGHTING) };
  layers.forEach((layer, i) => {
    if (layer.count) addLayer(layer.name, layer.colour, layer.count, visible[i], on => { visible[i] = on; });
  });
  if (meta.removed) {
    addLayer("removed", ORIGIN_COLOURS[REMOVED], meta.removed, showRemoved, on => { showRemoved = on; });
  }
  document.getElementById("about").textContent = meta.about;
  document.querySelector("select").addEventListener("change", event => { colourBy(event.target.value); redraw(); });
  colourBy(hash.get("colour") ?? "class");
  listen();
  draw();
  document.title = `ready: ${meta.count} voxels`;
}

main().catch(error => {
  document.title = `failed: ${error.message}`;
  document.getElementById("about").textContent = error.message;
});
