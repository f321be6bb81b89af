"use strict";

// 3D viewer of the map: recorded, instance or class colors; selection of objects; mapping progress.
// Colors are mixed as in overview.png: one color per instance, with some texture.

const VERTEX_SHADER = `
  attribute float firstSeen;
  varying vec3 vColor;
  varying vec3 vNormal;
  varying float vFirst;
  void main() {
    vColor = color.rgb;
    vNormal = normalMatrix * normal;
    vFirst = firstSeen;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  }`;

const FRAGMENT_SHADER = `
  uniform float painted;
  uniform float faded;
  uniform float now;
  uniform vec3 paint;
  uniform vec3 ground;
  varying vec3 vColor;
  varying vec3 vNormal;
  varying float vFirst;
  vec3 encoded(vec3 c) {
    return mix(c * 12.92, 1.055 * pow(max(c, vec3(0.0)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
  }
  void main() {
    if (vFirst > now) discard;
    vec3 own = encoded(vColor);
    float gray = (own.r + own.g + own.b) / 3.0;
    vec3 pale = vec3(0.70 + 0.22 * gray);
    vec3 shown = own * 1.08;
    if (painted > 1.5) shown = paint * (0.84 + 0.29 * gray);
    else if (painted > 0.5) shown = pale;
    float lit = 0.74 + 0.30 * max(dot(normalize(vNormal), normalize(vec3(-0.45, 0.75, 0.6))), 0.0);
    shown *= lit;
    shown = mix(min(shown, vec3(1.0)), ground, faded);
    gl_FragColor = vec4(min(shown, vec3(1.0)), 1.0);
  }`;

const FLIGHT_MS = 600; // duration of a camera movement
const FADED = 0.62; // fraction of the background color in unselected objects while an object is selected
const PATH_WIDTH = 0.0022; // radius of the path's tube, relative to the distance from camera to target in the initial view
const PATH_SIDES = 6; // number of sides of the path's tube
const CLICK_PX = 5; // maximum movement of the pointer during a click

class MapViewer {
  /** Shows maps in `canvas`. Calls `onChoose` with the id of a clicked object, or with null for the background. */
  constructor(canvas, onChoose) {
    this.canvas = canvas;
    this.onChoose = onChoose;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = "srgb-linear"; // the fragment shader already writes sRGB values
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.02, 500);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.addEventListener("change", () => this.draw());
    this.scene = new THREE.Scene();
    this.view = "color";
    this.confidence = 0;
    this.chosen = new Set();
    this.labels = []; // texts at objects: { element, center }
    this.now = 1;
    this.showPath = true;
    this.maps = [];
    this.shown = null;
    this.labelLayer = canvas.parentElement.querySelector(".labels");
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.listenForClicks();
  }

  /** Adds a map for `show`: `content` is its GLB file (ArrayBuffer), `data` the result of MapScene.data. */
  async add(content, data) {
    const { scene } = await new THREE.GLTFLoader().parseAsync(content, "");
    const map = { group: new THREE.Group(), data, parts: new Map(), path: pathTube(data) };
    const colors = new Map(data.objects.map((one) => [one.id, one]));
    scene.traverse((node) => {
      if (!node.isMesh) return;
      const geometry = node.geometry;
      geometry.computeVertexNormals();
      geometry.setAttribute("firstSeen", geometry.getAttribute("_first_seen"));
      const id = node.userData.id || 0;
      const part = new THREE.Mesh(geometry, material());
      part.userData = { id, object: colors.get(id) };
      map.parts.set(id, part);
    });
    map.group.add(...map.parts.values());
    if (map.path) map.group.add(map.path);
    this.maps.push(map);
  }

  /** Shows the map with this index. The camera moves to the initial view of the map, except with `keepView`. */
  show(number, { keepView = false } = {}) {
    if (this.shown) this.scene.remove(this.shown.group);
    this.shown = this.maps[number];
    this.scene.add(this.shown.group);
    this.chosen = new Set();
    if (!keepView) this.reset();
    this.paint();
  }

  reset() {
    const { eye, target, up, fov } = this.shown.data;
    this.flight = null;
    this.camera.up.set(...up);
    this.camera.fov = fov;
    // OrbitControls reads the up direction only in its constructor, so new controls are needed
    this.controls.dispose();
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.addEventListener("change", () => this.draw());
    this.controls.target.set(...target);
    const aspect = this.camera.aspect;
    const away = Math.max(1, 1.5 / aspect); // the initial view has an aspect ratio of 3:2
    this.camera.position.set(...eye).sub(this.controls.target).multiplyScalar(away).add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  setView(view) { this.view = view; this.paint(); }
  setConfidence(least) { this.confidence = least; this.paint(); }
  setPath(shown) { this.showPath = shown; this.paint(); }
  setTime(share) { this.now = share; this.paint(); }

  /** Fades all objects except those with these ids; no ids = fades nothing. */
  choose(ids) {
    this.chosen = new Set(ids);
    this.paint();
  }

  /** Replaces the names, colors and states of the objects. */
  setObjects(objects) {
    const byId = new Map(objects.map((one) => [one.id, one]));
    for (const part of this.shown.parts.values()) part.userData.object = byId.get(part.userData.id);
    this.paint();
  }

  /** Shows texts (Map by id) at the centroids of objects. */
  setLabels(texts) {
    this.labels = [...texts].filter(([id]) => this.shown.parts.has(id)).map(([id, text]) => {
      const element = document.createElement("span");
      element.textContent = text;
      return { element, center: centroid(this.shown.parts.get(id).geometry) };
    });
    this.labelLayer.replaceChildren(...this.labels.map(({ element }) => element));
    this.draw();
  }

  /** Moves the camera smoothly to an object. */
  flyTo(id) {
    const part = this.shown.parts.get(id);
    if (!part) return;
    part.geometry.computeBoundingSphere();
    const { center, radius } = part.geometry.boundingSphere;
    const away = this.camera.position.clone().sub(this.controls.target).normalize();
    const distance = Math.max(4.2 * radius, 0.5) / Math.min(1, this.camera.aspect);
    this.flight = {
      start: performance.now(),
      from: [this.camera.position.clone(), this.controls.target.clone()],
      to: [center.clone().addScaledVector(away, distance), center.clone()],
    };
    this.draw();
  }

  paint() {
    if (!this.shown) return;
    const ground = rgb(styleColor("--void"));
    for (const [id, part] of this.shown.parts) {
      const { object } = part.userData;
      const likely = object && isLikely(object, this.confidence);
      const { uniforms } = part.material;
      const colored = this.view === "color" && !(object && object.deleted);
      uniforms.painted.value = colored ? 0 : likely ? 2 : 1;
      if (object) uniforms.paint.value.set(...rgb(this.view === "class" ? object.classColor : object.color));
      uniforms.faded.value = !this.chosen.size || this.chosen.has(id) ? 0 : FADED;
      uniforms.ground.value.set(...ground);
      uniforms.now.value = this.now;
    }
    if (this.shown.path) {
      this.shown.path.visible = this.showPath;
      const steps = this.shown.data.path.length - 1;
      this.shown.path.geometry.setDrawRange(0, 6 * PATH_SIDES * Math.ceil(steps * this.now));
    }
    this.draw();
  }

  draw() {
    if (!this.pending) this.pending = requestAnimationFrame((time) => this.frame(time));
  }

  frame(time) {
    this.pending = 0;
    if (this.flight) {
      const { start, from, to } = this.flight;
      const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
      const share = still ? 1 : Math.min(1, Math.max(0, (time - start) / FLIGHT_MS));
      const eased = 1 - (1 - share) ** 3;
      this.camera.position.lerpVectors(from[0], to[0], eased);
      this.controls.target.lerpVectors(from[1], to[1], eased);
      if (share === 1) this.flight = null;
      this.draw();
    }
    this.controls.update();
    this.renderer.setClearColor(new THREE.Color().setRGB(...rgb(styleColor("--void"))), 1);
    this.renderer.render(this.scene, this.camera);
    this.placeLabels();
  }

  placeLabels() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    for (const { element, center } of this.labels) {
      const { x, y, z } = center.clone().project(this.camera);
      element.hidden = Math.max(Math.abs(x), Math.abs(y), Math.abs(z)) > 1;
      element.style.left = `${(width * (x + 1)) / 2}px`;
      element.style.top = `${(height * (1 - y)) / 2}px`;
    }
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  listenForClicks() {
    let start = null;
    this.canvas.addEventListener("pointerdown", (event) => { start = [event.clientX, event.clientY]; this.flight = null; });
    this.canvas.addEventListener("pointerup", (event) => {
      const moved = start && Math.hypot(event.clientX - start[0], event.clientY - start[1]);
      if (start && moved <= CLICK_PX) this.onChoose(this.objectAt(event.clientX, event.clientY));
      start = null;
    });
    this.canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
      if (event.key in turns) this.turn(...turns[event.key]);
      else if (event.key === "+" || event.key === "=") this.approach(0.85);
      else if (event.key === "-") this.approach(1 / 0.85);
      else if (event.key === "Escape") this.onChoose(null);
      else return;
      event.preventDefault();
    });
  }

  turn(around, over) {
    const up = this.camera.up.clone().normalize();
    const arm = this.camera.position.clone().sub(this.controls.target).applyAxisAngle(up, -around);
    const right = new THREE.Vector3().crossVectors(up, arm).normalize();
    const tilted = arm.clone().applyAxisAngle(right, over);
    if (Math.abs(tilted.clone().normalize().dot(up)) < 0.995) arm.copy(tilted);
    this.camera.position.copy(this.controls.target).add(arm);
    this.draw();
  }

  approach(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.draw();
  }

  /** Returns the id of the object at a position of the browser window, px; null for the background or unlikely objects. */
  objectAt(x, y) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const place = new THREE.Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(place, this.camera);
    const hits = ray.intersectObjects([...this.shown.parts.values()], false);
    const first = hits.find(({ object, face }) => {
      const seen = object.geometry.getAttribute("firstSeen");
      return seen.getX(face.a) <= this.now;
    });
    const object = first && first.object.userData.object;
    return object && isLikely(object, this.confidence) ? object.id : null;
  }
}

/** Returns true for objects with a minimum probability. Edited objects are always likely, deleted ones never. */
function isLikely(object, least) { return !object.deleted && (object.edited || object.exists >= least); }

function centroid(geometry) {
  const positions = geometry.getAttribute("position");
  const sum = new THREE.Vector3();
  for (let k = 0; k < positions.count; k += 1) sum.add(new THREE.Vector3().fromBufferAttribute(positions, k));
  return sum.divideScalar(positions.count);
}

function material() {
  return new THREE.ShaderMaterial({
    vertexShader: VERTEX_SHADER,
    fragmentShader: FRAGMENT_SHADER,
    vertexColors: true,
    uniforms: {
      painted: { value: 0 },
      faded: { value: 0 },
      now: { value: 1 },
      paint: { value: new THREE.Vector3() },
      ground: { value: new THREE.Vector3() },
    },
  });
}

/** Returns the camera path as a tube, colored from blue (start) to orange (end); null for fewer than two points. */
function pathTube({ path, eye, target }) {
  if (path.length < 2) return null;
  const curve = new THREE.CatmullRomCurve3(path.map((point) => new THREE.Vector3(...point)));
  const steps = path.length - 1;
  const width = PATH_WIDTH * new THREE.Vector3(...eye).distanceTo(new THREE.Vector3(...target));
  const geometry = new THREE.TubeGeometry(curve, steps, width, PATH_SIDES);
  const start = [40, 110, 220], end = [235, 90, 40];
  const shades = [];
  for (let k = 0; k <= steps; k += 1) {
    const shade = start.map((from, c) => (from + ((end[c] - from) * k) / steps) / 255);
    for (let side = 0; side <= PATH_SIDES; side += 1) shades.push(...shade);
  }
  geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(shades), 3));
  return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ vertexColors: true }));
}

function rgb(hex) {
  const value = parseInt(hex.slice(1), 16);
  return [(value >> 16) / 255, ((value >> 8) & 255) / 255, (value & 255) / 255];
}

function styleColor(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

/** Returns the GLB file (ArrayBuffer) in a script element of the page: base64-encoded and gzip-compressed. */
async function unpacked(element) {
  const bytes = Uint8Array.from(atob(element.textContent), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}
