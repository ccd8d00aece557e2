"use strict";
// Draws the voxels when something has changed, loads finer ones, and listens to mouse and touch.
// Lengths are in voxels, x east, y north, z up.

const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const ORIGINS = ["not seen by a camera", "seen", "inferred", "refined", "removed", "road and sidewalk meet"];
const ORIGIN_COLOURS = [[150, 150, 150], [90, 150, 255], [255, 170, 60], [90, 210, 120], [240, 60, 60],
                        [200, 120, 240]];

const meta = JSON.parse(document.getElementById("meta").textContent);
const canvas = document.querySelector("canvas");
const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
const MOST_BEADS = 500000;
// Pairs of corners of a box, the lower four first.
const EDGES = [0, 1, 2, 3].flatMap(i => [[i, (i + 1) % 4], [i + 4, (i + 1) % 4 + 4], [i, i + 4]]);
const classes = meta.classes.length;  // `other` is the last; then one entry for unlabelled, and those of lines
const edges = ({ corners, text }) => EDGES.map(([i, j]) => ({ points: [corners[i], corners[j]], text }));
const boxLayer = (name, colour, boxes) => ({ name, colour, count: boxes.length, lines: boxes.flatMap(edges) });
const lineLayers = [
  { name: "track", colour: [255, 214, 10], count: meta.tracks.length,
    lines: meta.tracks.map(points => ({ points, text: "track" })) },
  boxLayer("appeared", [80, 230, 255], meta.changes.filter(({ layer }) => layer === "appeared")),
  boxLayer("vanished", [255, 80, 220], meta.changes.filter(({ layer }) => layer === "vanished")),
  { name: "measured", colour: [255, 255, 255], count: 0, lines: [] },
];
const layers = [...meta.classes, { name: "unlabelled", colour: [150, 150, 150], count: meta.unlabelled },
                ...lineLayers];
const visible = layers.map(() => true), rows = [];
let showRemoved = false, leastConfidence = 0, mode = 0, frameAsked = false;
// on a screen that is higher than wide, from farther away
const far = Math.max(1, innerHeight / innerWidth);
const camera = { azimuth: -0.6, elevation: 0.65, distance: far * meta.view.distance, target: [...meta.view.target] };

// Puts voxels onto the graphics card: for each the cell, as numbers of a kind, then class, confidence and origin.
function upload(node, data, kind, stride) {
  node.vao = gl.createVertexArray();
  node.buffer = gl.createBuffer();
  gl.bindVertexArray(node.vao);
  gl.bindBuffer(gl.ARRAY_BUFFER, node.buffer);
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.vertexAttribPointer(0, 3, kind, false, stride, 0);
  gl.vertexAttribIPointer(1, 4, gl.UNSIGNED_BYTE, stride, stride - 4);
  [0, 1].forEach(place => gl.enableVertexAttribArray(place));
  node.state = "ready";
}

function drop(node) {
  gl.deleteVertexArray(node.vao);
  gl.deleteBuffer(node.buffer);
  node.state = "absent";
}

async function unpack(node, text) {
  const bytes = await inflated(text);
  if (bytes.length !== 9 * node.count) throw new Error(`found ${bytes.length} bytes, expected ${9 * node.count}`);
  upload(node, decoded(bytes, node.count), gl.SHORT, STRIDE);
}

// Lines, each with its layer, as beads; long ones have fewer.
function beadNode(lines) {
  const corner = lines[0].points[0], apartBy = (a, b) => Math.hypot(...a.map((v, k) => b[k] - v));
  const pairs = lines.flatMap(({ points, ...line }) => points.slice(1).map((b, i) => ({ a: points[i], b, line })));
  const length = pairs.reduce((sum, { a, b }) => sum + apartBy(a, b), 0);
  const apart = Math.max(LINE_HALF, length / MOST_BEADS), beads = [];
  for (const { a, b, line } of pairs) {
    const n = Math.ceil(apartBy(a, b) / apart);
    for (let s = 0; s < n; s++) beads.push({ at: a.map((v, k) => v - corner[k] - 0.5 + (b[k] - v) * s / n), line });
  }
  const node = { name: "lines", corner, scale: 1, count: beads.length, texts: beads.map(({ line }) => line.text) };
  const data = new ArrayBuffer(16 * beads.length), about = new Uint8Array(data);
  new Float32Array(data).set(beads.flatMap(({ at }) => [...at, 0]));
  beads.forEach(({ line }, i) => { about.set([line.layer, 0, 0, 0], 16 * i + 12); });
  upload(node, data, gl.FLOAT, 16);
  return node;
}

// Loads what a view needs; for that it drops what no view has needed for longest.
function load(wanted) {
  const now = ++scene.views, nodes = [...scene.nodes.values()].filter(node => node.level < meta.level);
  wanted.forEach(node => { node.lastUsed = now; });
  let held = nodes.reduce((sum, node) => sum + (node.state === "ready" || isComing(node) ? node.count : 0), 0);
  const spare = nodes.filter(node => node.state === "ready" && node.lastUsed < now)
    .sort((a, b) => b.lastUsed - a.lastUsed);
  const next = wanted.filter(({ state }) => state === "absent").slice(0, AT_ONCE - waiting());
  held += next.reduce((sum, { count }) => sum + count, 0);
  while (spare.length && held > most) {
    held -= spare.at(-1).count;
    drop(spare.pop());
  }
  next.forEach(ask);
}

function ask(node) {
  const script = document.createElement("script");
  node.state = "loading";
  const ended = what => () => {
    script.remove();
    if (node.state === "loading") fail(node, new Error(`${meta.folder}/${node.name}.js ${what}`));
  };
  script.onload = ended("is damaged");
  script.onerror = ended("is not beside this page");
  script.setAttribute("src", `${encodeURIComponent(meta.folder)}/${node.name}.js`);
  document.head.append(script);
}

// Called by the files in the folder.
function voxels(name, text) {
  const node = scene.nodes.get(name);
  if (node?.state !== "loading") return;
  node.state = "unpacking";
  unpack(node, text)
    .catch(() => fail(node, new Error(`${meta.folder}/${name}.js is damaged, or of another page`)))
    .finally(redraw);
}

function fail(node, error) {
  node.state = "failed";
  document.getElementById("about").textContent =
    `${meta.about}, joined to ${inMetres(2 ** meta.level)} m where finer ones are missing: ${error.message}`;
  redraw();
}

const isComing = ({ state }) => state === "loading" || state === "unpacking";
const waiting = () => [...scene.nodes.values()].filter(isComing).length;
const inMetres = length => +(length * meta.voxel_m).toFixed(3);

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
  const { right, up, forward } = axesOf(camera), { cubes, lighting } = scene;
  const eye = camera.target.map((t, k) => t - camera.distance * forward[k]), focal = 0.9 * canvas.height;
  const tangents = [canvas.width, canvas.height].map(pixels => pixels / (2 * focal));
  const view = { eye, axes: [right, up, forward], focal, tangents }, wanted = needed(scene.roots, view);
  scene.drawn = ranges(scene.roots, wanted, view);
  for (const node of [scene.lines, scene.measured]) if (node) scene.drawn.push([node, 0, node.count]);
  const palette = layers.flatMap((layer, i) => [...layer.colour.map(c => c / 255), visible[i] ? 1 : 0]);
  const flat = colours => colours.flat().map(c => c / 255);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.enable(gl.DEPTH_TEST);
  gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
  gl.clearBufferuiv(gl.COLOR, 1, [0, 0, 0, 0]);
  gl.clearBufferfv(gl.DEPTH, 0, [1]);
  gl.useProgram(cubes.linked);
  gl.uniformMatrix3fv(cubes.at("axes"), false, [...right, ...up, ...forward]);
  gl.uniform1f(cubes.at("eyeHeight"), eye[2]);
  gl.uniform2f(cubes.at("size"), canvas.width, canvas.height);
  gl.uniform1f(cubes.at("focal"), focal);
  gl.uniform1f(cubes.at("largest"), gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE)[1]);
  gl.uniform4fv(cubes.at("palette"), palette);
  gl.uniform3fv(cubes.at("ramp"), flat(RAMP));
  gl.uniform3fv(cubes.at("origins"), flat(ORIGIN_COLOURS));
  gl.uniform2fv(cubes.at("heights"), meta.heights);
  gl.uniform1f(cubes.at("leastConfidence"), leastConfidence);
  gl.uniform1i(cubes.at("mode"), mode);
  gl.uniform1i(cubes.at("firstLine"), classes + 1);
  gl.uniform1i(cubes.at("removed"), showRemoved ? 1 : 0);
  let before = 0;
  for (const [i, [node, first, count]] of scene.drawn.entries()) {
    if (node !== scene.drawn[i - 1]?.[0]) {
      node.before = before;
      before += node.count;
      gl.bindVertexArray(node.vao);
      gl.uniform3fv(cubes.at("corner"), node.corner.map((v, k) => v - eye[k]));
      gl.uniform1f(cubes.at("scale"), node.scale);
      gl.uniform1ui(cubes.at("before"), node.before);
      gl.depthFunc(node === scene.measured ? gl.ALWAYS : gl.LESS);  // seen through the ground that it is measured on
    }
    gl.drawArrays(gl.POINTS, first, count);
  }
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.disable(gl.DEPTH_TEST);
  gl.useProgram(lighting.linked);
  [["paint", target.paint], ["depths", target.depth]].forEach(([name, t], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, t);
    gl.uniform1i(lighting.at(name), unit);
  });
  gl.uniform2f(lighting.at("size"), canvas.width, canvas.height);
  gl.bindVertexArray(scene.nothing);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  load(wanted);
}

function redraw() {
  if (!frameAsked) frameAsked = requestAnimationFrame(draw);
  linkSoon();
}

const clampedDistance = distance => Math.min(FAR / 10, Math.max(5, distance));
const clampedElevation = elevation => Math.min(1.55, Math.max(0.02, elevation));

function zoom(factor) {
  camera.distance = clampedDistance(camera.distance * factor);
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
      const { right, forward } = axesOf(camera);
      const step = camera.distance / (0.9 * innerHeight * Math.max(1, pointers.size));  // each finger moves its part
      const level = Math.hypot(forward[0], forward[1]);
      camera.target[0] += step * (-dx * right[0] + dy * forward[0] / level);
      camera.target[1] += step * (-dx * right[1] + dy * forward[1] / level);
    } else {
      camera.azimuth += 0.006 * dx;
      camera.elevation = clampedElevation(camera.elevation + 0.006 * dy);
    }
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => {
    pointers.delete(event.pointerId);
    if (name === "pointerup" && moved < (event.pointerType === "touch" ? 12 : 4)) pick(event);
  });
  canvas.addEventListener("dblclick", goTo);
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  addEventListener("resize", redraw);
  document.querySelector("select").addEventListener("change", event => { colourBy(event.target.value); redraw(); });
  document.getElementById("least").addEventListener("input", event => { cutAt(+event.target.value); redraw(); });
  document.getElementById("measure").addEventListener("change", event => measure(event.target.checked));
}

function patchOf(colour) {
  const patch = document.createElement("i");
  patch.style.background = `rgb(${colour})`;
  return patch;
}

// `coloursHere(mode)`: whether a colour mode paints the layer in its own colour.
function addLayer(name, colour, count, coloursHere, isOn, change) {
  const row = document.createElement("label"), box = document.createElement("input");
  const patch = patchOf(colour), number = document.createElement("b");
  Object.assign(box, { type: "checkbox", onchange: () => { change(box.checked); redraw(); } });
  number.textContent = count.toLocaleString("en");
  row.append(box, patch, name, number);
  document.getElementById("layers").append(row);
  rows.push(() => {
    box.checked = isOn();
    patch.style.visibility = coloursHere(mode) ? "visible" : "hidden";
  });
}

function addLayers() {
  layers.forEach(({ name, colour, count }, i) => {
    const own = m => m === 0 || i > classes || (i === classes && m === 2);
    if (count) addLayer(name, colour, count, own, () => visible[i], on => { visible[i] = on; });
  });
  if (meta.removed) addLayer("removed", ORIGIN_COLOURS[REMOVED], meta.removed, () => true,
                             () => showRemoved, on => { showRemoved = on; });
  ORIGINS.forEach((name, i) => {
    if (i === REMOVED) return;  // a layer of its own
    const row = document.createElement("div");
    row.append(patchOf(ORIGIN_COLOURS[i]), name);
    document.getElementById("origins").append(row);
  });
}

function colourBy(name) {
  const select = document.querySelector("select"), ramp = document.getElementById("ramp");
  select.value = name;
  if (select.selectedIndex < 0) select.selectedIndex = 0;
  mode = select.selectedIndex;
  const [low, high] = mode === 1 ? meta.heights.map(h => (h + meta.origin[2]) * meta.voxel_m) : [0, 1];
  [...ramp.children].forEach((tick, i) => {
    tick.textContent = mode === 1 ? `${(low + (high - low) * i / 2).toFixed(1)} m` : low + (high - low) * i / 2;
  });
  ramp.hidden = mode !== 1 && mode !== 2;
  ramp.style.background = `linear-gradient(90deg, ${RAMP.map(c => `rgb(${c})`)})`;
  document.getElementById("origins").hidden = mode !== 3;
  document.getElementById("lighter").hidden = mode !== 0 || !meta.inferred;
  rows.forEach(update => update());
}

// Labels that are less sure are shown as unlabelled.
function cutAt(confidence) {
  const slider = document.getElementById("least");
  slider.value = leastConfidence = Math.min(1, Math.max(0, confidence || 0));
  slider.nextSibling.textContent = leastConfidence.toFixed(2);
}

async function main() {
  if (!gl) throw new Error("this browser has no WebGL 2");
  const nodes = nodesOf(meta.nodes), roots = [...nodes.values()].filter(({ level }) => level === meta.level);
  const texts = document.getElementById("voxels").textContent.split("\n");
  await Promise.all(roots.map((root, i) => unpack(root, texts[i])));
  const lines = lineLayers.flatMap((layer, i) => layer.lines.map(line => ({ ...line, layer: classes + 1 + i })));
  scene = { nodes, roots, drawn: [], views: 0, lines: lines.length ? beadNode(lines) : null, measured: null,
            nothing: gl.createVertexArray(), cubes: program(VERTEX, FRAGMENT), lighting: program(SCREEN, LIGHTING) };
  addLayers();
  document.getElementById("about").textContent = meta.about;
  document.getElementById("panel").open = innerWidth > 600;
  followLink();
  listen();
  draw();
  document.title = `ready: ${meta.count} voxels`;
}

main().catch(error => {
  document.title = `failed: ${error.message}`;
  document.getElementById("about").textContent = error.message;
});
