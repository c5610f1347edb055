/* The mesh of pages and of the studio: drawn only when something changed. */

const TURN = Math.PI / 24;
const NEARER = 1.2;
const FILLED = 0.9;
const MARK_PX = 6;
const WINDS = ["north", "north-east", "east", "south-east", "south", "south-west", "west",
  "north-west"];

/* A mesh that turns, of binary glTF: east is x, up is y, south is z. `told` gets words on where
   it is seen from, `lost` is called when the browser takes its graphics memory back. Returns
   `pick`, which gives what is under a pixel of the canvas, with its `point`, or null, `mark`,
   which shows some points and the lines between, and `show`, which draws another model, in the
   same axes, that is brought up to date before each frame; `dress` makes
   a model ready for it, `forget` gives its memory back. */
async function startMesh(root, canvas, bytes, {told, lost}) {
  const view = canvas.parentElement;
  const renderer = new three.WebGLRenderer({canvas, antialias: true, preserveDrawingBuffer: true});
  renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
  const scene = new three.Scene();
  scene.background = new three.Color(0xf3f6f8);
  const lamp = new three.DirectionalLight(0xffffff, 2.6);
  scene.add(new three.HemisphereLight(0xffffff, 0x8c98a0, 1.1), lamp, lamp.target);

  const model = (await parse(bytes)).scene;
  scene.add(model);
  const box = new three.Box3().setFromObject(model);
  const ball = box.getBoundingSphere(new three.Sphere());
  lamp.position.copy(ball.center).add(new three.Vector3(-1, 0.7, -0.5).multiplyScalar(ball.radius));
  lamp.target.position.copy(ball.center);
  const dressed = new Set();
  let isRelief = false;
  const grey = new three.MeshLambertMaterial({color: 0xc9c4b8, side: 2});
  let current = {group: model, update() {}, moved() {}};
  dress(model);

  function dress(some) {
    some.traverse((part) => {
      if (!part.isMesh) return;
      if (!part.geometry.attributes.normal) part.geometry.computeVertexNormals();
      part.userData.own = part.material;
      if (isRelief) part.material = grey;
      dressed.add(part);
    });
    return some;
  }

  function forget(some) {
    some.traverse((part) => {
      if (!dressed.delete(part)) return;
      part.geometry.dispose();
      part.userData.own.map?.dispose();
      part.userData.own.dispose();
    });
  }

  function show(other) {
    scene.remove(current.group);
    current = other;
    scene.add(current.group);
    draw();
  }

  const camera = new three.PerspectiveCamera(40, 1, ball.radius / 500, ball.radius * 40);
  const controls = new three.OrbitControls(camera, canvas);
  controls.minDistance = ball.radius * 0.05;
  controls.maxDistance = ball.radius * 8;
  controls.zoomSpeed = 1.2;
  controls.enableZoom = false;
  /* A page that scrolls must not stop at its mesh: the wheel zooms only what was chosen. */
  canvas.addEventListener("focus", () => { controls.enableZoom = true; });
  canvas.addEventListener("blur", () => { controls.enableZoom = false; });
  canvas.addEventListener("pointerdown", () => canvas.focus({preventScroll: true}));

  let marks = [];
  let asked = false;
  function draw() {
    note();
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      current.update();
      const perPx = 2 * Math.tan(camera.fov * Math.PI / 360) / canvas.clientHeight;
      marks.forEach((one) => {
        if (one.isMesh) one.scale.setScalar(MARK_PX * perPx * camera.position.distanceTo(
          one.position));
      });
      renderer.render(scene, camera);
    });
  }

  function note() {
    const from = new three.Spherical().setFromVector3(camera.position.clone().sub(controls.target));
    const compass = (180 - from.theta * 180 / Math.PI + 360) % 360;
    const above = 90 - from.phi * 180 / Math.PI;
    canvas.dataset.azimuth = compass.toFixed(3);
    canvas.dataset.above = above.toFixed(3);
    canvas.dataset.distance = from.radius.toPrecision(6);
    told(above > 88
      ? "Seen from above"
      : "Seen from the " + WINDS[Math.round(compass / 45) % 8] + ", " + Math.round(above)
        + "° above the horizon");
  }

  function turn(around, over, farther = 1) {
    const from = new three.Spherical().setFromVector3(camera.position.clone().sub(controls.target));
    from.theta += around;
    from.phi = Math.min(Math.PI - 0.01, Math.max(0.01, from.phi + over));
    from.radius = Math.min(controls.maxDistance, Math.max(
      controls.minDistance, from.radius * farther));
    camera.position.setFromSpherical(from).add(controls.target);
    controls.update();
    draw();
  }

  /* As near as the whole box fits, by halving the span of distances. */
  function reset() {
    controls.target.copy(ball.center);
    const corners = [...Array(8).keys()].map((i) => new three.Vector3(
      i & 1 ? box.max.x : box.min.x, i & 2 ? box.max.y : box.min.y, i & 4 ? box.max.z : box.min.z,
    ));
    const fits = (away) => {
      camera.position.setFromSphericalCoords(away, Math.PI / 4, Math.PI / 9).add(ball.center);
      camera.lookAt(ball.center);
      camera.updateMatrixWorld();
      return corners.map((corner) => corner.clone().project(camera))
        .every(({x, y}) => Math.max(Math.abs(x), Math.abs(y)) < FILLED);
    };
    let [near, far] = [1.05 * ball.radius, controls.maxDistance];
    for (let step = 0; step < 24; step += 1) {
      const middle = (near + far) / 2;
      if (fits(middle)) far = middle;
      else near = middle;
    }
    fits(far);
    controls.update();
    draw();
  }

  function relief(button) {
    isRelief = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(isRelief));
    dressed.forEach((part) => { part.material = isRelief ? grey : part.userData.own; });
    draw();
  }

  const caster = new three.Raycaster();
  function pick(x, y) {
    const {clientWidth: width, clientHeight: height} = canvas;
    caster.setFromCamera(new three.Vector2(2 * x / width - 1, 1 - 2 * y / height), camera);
    const seen = current.group === model ? [model] : current.group.children.filter((part) =>
      part.visible);
    return caster.intersectObjects(seen, true)[0] || null;
  }

  /* Seen through what is before them, from afar as large as from near. */
  function mark(points, colour) {
    marks.forEach((one) => scene.remove(one));
    const dot = new three.SphereGeometry(1, 16, 12);
    const paint = new three.MeshBasicMaterial({color: colour, depthTest: false});
    marks = points.map((point) => {
      const one = new three.Mesh(dot, paint);
      one.position.copy(point);
      return one;
    });
    if (points.length > 1) {
      const line = new three.BufferGeometry().setFromPoints(points);
      marks.push(new three.Line(line, new three.LineBasicMaterial(
        {color: colour, depthTest: false})));
    }
    marks.forEach((one) => {
      one.renderOrder = 1;
      scene.add(one);
    });
    draw();
  }

  const acts = {
    left: () => turn(-TURN, 0), right: () => turn(TURN, 0),
    up: () => turn(0, -TURN), down: () => turn(0, TURN),
    nearer: () => turn(0, 0, 1 / NEARER), farther: () => turn(0, 0, NEARER), reset, relief,
  };
  const keys = {
    ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down",
    "+": "nearer", "=": "nearer", "-": "farther", 0: "reset",
  };
  root.querySelectorAll("button[data-act]").forEach((button) => {
    button.addEventListener("click", () => acts[button.dataset.act](button));
  });
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    acts[keys[event.key]]();
  });
  controls.addEventListener("change", () => {
    current.moved();
    draw();
  });
  let placed = false;
  new ResizeObserver(() => {
    const {clientWidth: width, clientHeight: height} = view;
    if (!width || !height) return;
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    if (placed) {
      draw();
      return;
    }
    placed = true;
    reset();
  }).observe(view);
  canvas.addEventListener("webglcontextlost", lost);
  return {pick, mark, show, dress, forget, draw, camera, canvas};
}

/* What the page holds; a mesh that is too large for the browser is a fault like any other. */
async function bytesOf(id) {
  const text = atob(document.getElementById(id).textContent);
  return Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer;
}

/* Textures as pictures, which the page's policy lets in; the loader's own way would fetch them. */
function parse(bytes) {
  const loader = new three.GLTFLoader();
  loader.register((parser) => {
    parser.textureLoader = new three.TextureLoader(parser.options.manager);
    return {name: "textures as pictures"};
  });
  return loader.parseAsync(bytes, "");
}

function hasWebgl() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (context) context.getExtension("WEBGL_lose_context")?.loseContext();
  return Boolean(context);
}

function showStill(root, why) {
  root.hidden = true;
  root.parentElement.classList.remove("lives");
  document.getElementById("mesh-note").textContent = why;
}

function awaitMesh() {
  const root = document.getElementById("mesh");
  const canvas = document.getElementById("mesh-canvas");
  if (!hasWebgl()) {
    showStill(root, "This browser has no WebGL, which turning the mesh needs: this is a still "
      + "picture.");
    return;
  }
  root.hidden = false;
  root.parentElement.classList.add("lives");
  const watch = new IntersectionObserver((entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    watch.disconnect();
    const told = (text) => { document.getElementById("mesh-readout").textContent = text; };
    const lost = () =>
      showStill(root, "The browser took its graphics memory back: this is a still picture.");
    bytesOf("mesh-glb").then((bytes) => startMesh(root, canvas, bytes, {told, lost}))
      .then(() => { root.dataset.ready = ""; }, (fault) => {
      showStill(root, "The mesh cannot be shown here (" + fault.message
        + "): this is a still picture.");
      throw fault;
    });
  }, {rootMargin: "200px"});
  watch.observe(root);
}

if (document.getElementById("mesh-glb")) awaitMesh();
