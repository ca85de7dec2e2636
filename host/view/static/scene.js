// The catheter, the tissue and the target in three dimensions. Millimetres; the base frame with e3 upwards.

import {OrbitControls, THREE} from "./vendor/three.js";

const MM = 1000, MM_PER_N = 50, SMALLEST_N = 0.015, BANDS_MM = [3.2, 6.4, 9.6], HOME = [74, -39, 36], LOOK = [0, -5, 15];
// The drawn tissue has this radius; a point further away is not on it.
const PICK_MM = 20;

const vector = m => new THREE.Vector3(m[0] * MM, m[1] * MM, m[2] * MM);

function colors() {
  const style = getComputedStyle(document.documentElement);
  return name => new THREE.Color(style.getPropertyValue(`--${name}`).trim());
}

function label(text, color) {
  const canvas = document.createElement("canvas"), font = "600 34px system-ui, sans-serif";
  const g = canvas.getContext("2d");
  g.font = font;
  canvas.width = Math.max(64, Math.ceil(g.measureText(text).width) + 8);
  canvas.height = 64;
  g.font = font;  // a new size resets the context
  g.textAlign = "center";
  g.textBaseline = "middle";
  g.fillStyle = `#${color.getHexString()}`;
  g.fillText(text, canvas.width / 2, 32);
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({map: new THREE.CanvasTexture(canvas), depthWrite: false}));
  sprite.scale.set(4.2 * canvas.width / 64, 4.2, 1);
  return sprite;
}

// A computer without a graphics card draws by its processor: there smooth edges cost more than all else in the picture.
function drawnInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = names ? String(gl.getParameter(names.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

class Arrow {
  constructor(color, opacity) {
    const material = new THREE.MeshStandardMaterial({color, transparent: opacity < 1, opacity, roughness: 0.5});
    this.group = new THREE.Group();
    this.shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.38, 0.38, 1, 16), material);
    this.head = new THREE.Mesh(new THREE.ConeGeometry(1.0, 2.4, 20), material);
    this.group.add(this.shaft, this.head);
  }

  point(from, force) {
    const length = force.length === 3 ? Math.hypot(...force) * MM_PER_N : 0;
    this.group.visible = length > SMALLEST_N * MM_PER_N;
    if (!this.group.visible) return;
    this.group.position.copy(from);
    this.group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), new THREE.Vector3(...force).normalize());
    this.shaft.scale.y = length;
    this.shaft.position.y = length / 2;
    this.head.position.y = length + 1.2;
  }
}

export class Scene {
  constructor(holder, radius_m) {
    this.holder = holder;
    this.radius = radius_m * MM;
    this.renderer = new THREE.WebGLRenderer({canvas: holder.querySelector("canvas"), antialias: !drawnInSoftware(), alpha: true});
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.camera = new THREE.PerspectiveCamera(34, 1, 1, 1000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.enableDamping = false;
    this.renderer.domElement.style.touchAction = "pan-y";
    this.resetView();
    this.#build();
    new ResizeObserver(() => this.#resize()).observe(holder);
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => { this.#build(); this.render(); });
    this.controls.addEventListener("change", () => this.render());
    this.#resize();
  }

  resetView() {
    this.camera.position.set(...HOME);
    this.controls.target.set(...LOOK);
    this.controls.update();
  }

  #resize() {
    const width = this.holder.clientWidth, height = this.holder.clientHeight;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.fov = this.camera.aspect < 1.2 ? 40 : 34;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  #build() {
    const color = this.color = colors();
    const world = this.world = new THREE.Scene();
    world.add(new THREE.HemisphereLight(0xffffff, 0x667788, 2.4));
    const sun = new THREE.DirectionalLight(0xffffff, 1.8);
    sun.position.set(60, -80, 120);
    world.add(sun);
    const grid = new THREE.GridHelper(80, 8, color("edge"), color("grid"));
    grid.rotation.x = Math.PI / 2;
    world.add(grid);
    this.#axes(world);
    const sheath = new THREE.Mesh(new THREE.CylinderGeometry(this.radius * 1.55, this.radius * 1.55, 22, 32, 1, true),
      new THREE.MeshStandardMaterial({color: color("sheath"), roughness: 0.5, metalness: 0.1, side: THREE.DoubleSide}));
    sheath.rotation.x = Math.PI / 2;
    sheath.position.z = -11;
    world.add(sheath);
    this.catheter = new THREE.Group();
    world.add(this.catheter);
    this.plan = new THREE.Group();
    this.pressed = new THREE.Group();
    this.drawnPlan = "";
    world.add(this.plan, this.pressed);
    this.#wall(world);
    this.#target(world);
    this.force = new Arrow(color("force"), 1);
    this.estimate = new Arrow(color("estimate"), 0.6);
    this.sensors = {tip: new THREE.AxesHelper(4), shaft: new THREE.AxesHelper(4), rear: new THREE.AxesHelper(4)};
    const sensors = Object.values(this.sensors);
    world.add(this.force.group, this.estimate.group, ...sensors);
    for (const part of [this.wall, this.target, this.force.group, this.estimate.group, ...sensors]) part.visible = false;
    if (this.newest) this.show(...this.newest);
  }

  #axes(world) {
    const color = this.color;
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((axis, index) => {
      const end = new THREE.Vector3(...axis).multiplyScalar(index === 2 ? 36 : 16);
      const line = new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(), end]);
      world.add(new THREE.Line(line, new THREE.LineBasicMaterial({color: color("muted"), transparent: true, opacity: 0.55})));
      const name = label(`e${index + 1}`, color("muted"));
      name.position.copy(end.multiplyScalar(index === 2 ? 1.06 : 1.2));
      world.add(name);
    });
  }

  #wall(world) {
    const material = new THREE.MeshStandardMaterial({
      color: this.color("tissue"), transparent: true, opacity: 0.34, side: THREE.DoubleSide, depthWrite: false, roughness: 0.9});
    const line = new THREE.LineBasicMaterial({color: this.color("tissue"), transparent: true, opacity: 0.55});
    this.wall = new THREE.Group();
    this.wall.add(new THREE.Mesh(new THREE.CircleGeometry(15, 64), material));
    for (const radius of [5, 10, 15]) {
      const circle = new THREE.EllipseCurve(0, 0, radius, radius).getPoints(72).map(p => new THREE.Vector3(p.x, p.y, 0));
      this.wall.add(new THREE.Line(new THREE.BufferGeometry().setFromPoints(circle), line));
    }
    world.add(this.wall);
  }

  #target(world) {
    const material = new THREE.MeshStandardMaterial({color: this.color("target"), roughness: 0.4});
    this.target = new THREE.Group();
    this.target.add(new THREE.Mesh(new THREE.SphereGeometry(0.7, 20, 14), material));
    this.ring = new THREE.Mesh(new THREE.TorusGeometry(2.2, 0.22, 10, 48), material);
    this.target.add(this.ring);
    world.add(this.target);
    this.picked = new THREE.Mesh(new THREE.SphereGeometry(0.9, 20, 14),
      new THREE.MeshStandardMaterial({color: this.color("target"), transparent: true, opacity: 0.5}));
    this.picked.visible = false;
    world.add(this.picked);
  }

  #tube(points) {
    const metal = new THREE.MeshStandardMaterial({color: this.color("sheath"), roughness: 0.35, metalness: 0.1});
    const skin = new THREE.MeshStandardMaterial({color: this.color("catheter"), roughness: 0.45});
    for (const part of this.catheter.children) { part.geometry.dispose(); part.material.dispose(); }
    this.catheter.clear();
    const curve = new THREE.CatmullRomCurve3(points), length = curve.getLength();
    this.catheter.add(new THREE.Mesh(new THREE.TubeGeometry(curve, 60, this.radius, 14), skin));
    const tip = new THREE.Mesh(new THREE.SphereGeometry(this.radius * 1.04, 20, 14), metal);
    tip.position.copy(points[points.length - 1]);
    this.catheter.add(tip);
    for (const back of BANDS_MM.filter(mm => mm < length - 2)) {
      const at = 1 - back / length;
      const band = new THREE.Mesh(new THREE.CylinderGeometry(this.radius * 1.07, this.radius * 1.07, 1.3, 20), metal);
      band.position.copy(curve.getPointAt(at));
      band.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), curve.getTangentAt(at));
      this.catheter.add(band);
    }
  }

  // The plan that is carried out: a thin line for each step, fainter where it is done, thick with a ball for the step now.
  // A step that a puncture bends is in the force's colour.
  #planned(plan) {
    const key = plan ? JSON.stringify([plan.id, plan.step, plan.shapes.map(Boolean), plan.pressed]) : "";
    if (key === this.drawnPlan) return;
    this.drawnPlan = key;
    for (const part of this.plan.children) { part.geometry.dispose(); part.material.dispose(); }
    this.plan.clear();
    (plan?.shapes || []).forEach((shape, step) => {
      if (!shape) return;
      const now = step === plan.step, color = this.color(plan.loads[step] > 0 ? "force" : "plan");
      const opacity = now ? 1 : step < plan.step ? 0.18 : 0.5;
      const material = new THREE.MeshStandardMaterial({color, transparent: !now, opacity, roughness: 0.6});
      const points = shape.map(vector), curve = new THREE.CatmullRomCurve3(points);
      this.plan.add(new THREE.Mesh(new THREE.TubeGeometry(curve, 24, this.radius * (now ? 0.45 : 0.16), 8), material));
      const ball = new THREE.Mesh(new THREE.SphereGeometry(this.radius * (now ? 0.9 : 0.4), 16, 12), material);
      ball.position.copy(points[points.length - 1]);
      this.plan.add(ball);
    });
    this.#pressing(plan?.pressed);
  }

  // The goal under the planned contact force: the loaded shape, the force of the tip on the tissue, and its value.
  #pressing(pressed) {
    this.pressed.traverse(part => { part.geometry?.dispose(); part.material?.map?.dispose(); part.material?.dispose(); });
    this.pressed.clear();
    if (!pressed) return;
    const color = this.color("loaded"), points = pressed.shape.map(vector), tip = points[points.length - 1];
    const tube = new THREE.TubeGeometry(new THREE.CatmullRomCurve3(points), 32, this.radius * 0.6, 10);
    // Wider than a step and transparent: both are seen where the load changes little.
    const skin = new THREE.MeshStandardMaterial({color, transparent: true, opacity: 0.6, roughness: 0.6, depthWrite: false});
    const arrow = new Arrow(color, 1), value = label(`${Math.hypot(...pressed.force).toFixed(2)} N`, color);
    arrow.point(tip, pressed.force);
    // To the left of the arrow's middle: above its head it would often lie outside the picture.
    value.position.copy(tip).addScaledVector(new THREE.Vector3(...pressed.force), 0.5 * MM_PER_N);
    value.center.set(1.12, 0.5);
    this.pressed.add(new THREE.Mesh(tube, skin), arrow.group, value);
  }

  show(drawn, mode, plan = null) {
    this.newest = [drawn, mode, plan];
    this.#planned(plan);
    if (drawn.shape && drawn.shape.length > 2) this.#tube(drawn.shape.map(vector));
    this.catheter.visible = Boolean(drawn.shape);
    const tip = drawn.tip.length ? vector(drawn.tip) : null;
    const pressing = mode === "contact" || mode === "approach";
    this.target.visible = drawn.target.length === 3 && mode !== "disarmed" && mode !== "homing";
    if (this.target.visible) this.target.position.copy(vector(drawn.target));
    // Where the wall is, is known only while the tip is on it; before, it is where it was said to be.
    const place = mode === "contact" ? tip : drawn.target.length === 3 ? vector(drawn.target) : null;
    this.wall.visible = pressing && drawn.into.length === 3 && place !== null;
    if (drawn.into.length === 3) {
      const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), new THREE.Vector3(...drawn.into).normalize());
      this.ring.quaternion.copy(turn);
      if (this.wall.visible) {
        this.wall.quaternion.copy(turn);
        this.wall.position.copy(place).addScaledVector(new THREE.Vector3(...drawn.into), this.radius);
      }
    }
    this.force.point(tip || new THREE.Vector3(), tip ? drawn.force : []);
    this.estimate.point(tip || new THREE.Vector3(), tip ? drawn.estimate : []);
    for (const [name, axes] of Object.entries(this.sensors)) {
      const pose = drawn.poses[name];
      axes.visible = Boolean(pose && pose.length === 7);
      if (!axes.visible) continue;
      axes.position.copy(vector(pose));
      axes.quaternion.set(pose[4], pose[5], pose[6], pose[3]);
    }
    this.render();
  }

  // The point of the tissue under a place of the page (CSS pixels), where the tip's centre would touch: {point, normal},
  // millimetres and unit vector. The tissue is the plane through the wall or the target; null while neither is known.
  pick(clientX, clientY) {
    const drawn = this.newest?.[0], pressing = this.newest?.[1] === "contact";
    if (!drawn || drawn.into.length !== 3) return null;
    const on = pressing && drawn.tip.length === 3 ? drawn.tip : drawn.target;
    if (on.length !== 3) return null;
    const box = this.renderer.domElement.getBoundingClientRect();
    const place = new THREE.Vector2(2 * (clientX - box.left) / box.width - 1, 1 - 2 * (clientY - box.top) / box.height);
    const ray = new THREE.Raycaster(), normal = new THREE.Vector3(...drawn.into).normalize();
    ray.setFromCamera(place, this.camera);
    const point = ray.ray.intersectPlane(new THREE.Plane().setFromNormalAndCoplanarPoint(normal, vector(on)), new THREE.Vector3());
    if (!point || point.distanceTo(vector(on)) > PICK_MM) return null;
    this.picked.position.copy(point);
    this.picked.visible = true;
    this.render();
    return {point: point.toArray(), normal: normal.toArray()};
  }

  render() {
    if (!this.world || this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.renderer.render(this.world, this.camera); });
  }
}
