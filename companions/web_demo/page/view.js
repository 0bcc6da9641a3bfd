/** The scene in three.js: what MuJoCo's model has of geometry, drawn from outside and by the robot's camera. */

import * as THREE from "three";
import { OrbitControls } from "./lib/OrbitControls.js";

const [PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH] = [0, 2, 3, 4, 5, 6, 7]; // mjtGeom
const DRAWN_GROUPS = [0, 1, 2, 3];
const LOOKAT = [1.25, 0, 1.0];
const FROM = [2.25, -3.9, 1.95]; // the outside view of the videos, a little farther away
const HALF_HEIGHT = 0.364; // of the outside view, at a distance of 1
const LEAST_ASPECT = 1.4; // width over height; what is narrower shows as much of the throw
const ONLY_OUTSIDE = 1; // layer of what the robot's camera does not see

export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {HTMLElement} inset frame of the camera's picture
   * @param {object} camera of `task.camera`
   */
  constructor(canvas, inset, camera) {
    Object.assign(this, { canvas, inset });
    THREE.Object3D.DEFAULT_UP.set(0, 0, 1);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(window.devicePixelRatio);
    this.renderer.shadowMap.enabled = true;
    this.renderer.toneMapping = THREE.ACESFilmicToneMapping;
    this.renderer.autoClear = false;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0xdfe6ec);
    this.scene.fog = new THREE.Fog(0xdfe6ec, 7, 16);
    this.scene.add(...lights());
    this.outside = new THREE.PerspectiveCamera(40, 1, 0.05, 30);
    this.outside.position.set(...FROM);
    this.outside.layers.enable(ONLY_OUTSIDE);
    this.controls = new OrbitControls(this.outside, canvas);
    this.controls.target.set(...LOOKAT);
    this.controls.maxPolarAngle = 1.55;
    [this.controls.minDistance, this.controls.maxDistance] = [1, 8];
    this.controls.update();
    this.firstAzimuth = this.controls.getAzimuthalAngle();
    this.robotCamera = pinholeCamera(camera.true);
    this.bodies = new Map();
  }

  /** Add lines or marks that the robot's camera does not see. */
  addMark(object) {
    object.traverse((each) => each.layers.set(ONLY_OUTSIDE));
    this.scene.add(object);
    return object;
  }

  /** Show the model with an object; it is drawn once. */
  show(name, model) {
    if (!this.bodies.has(name)) {
      const meshes = Array.from({ length: model.ngeom }, (_, geom) => meshOf(model, geom));
      const group = new THREE.Group().add(...meshes.filter(Boolean));
      this.scene.add(group);
      this.bodies.set(name, { group, meshes });
    }
    for (const [other, { group }] of this.bodies) group.visible = other === name;
    this.shown = this.bodies.get(name).meshes;
  }

  /** Draw both pictures between two states, see `poses`; a share of 1 is the second. */
  draw(before, now, share) {
    const [a, b, matrix] = [new THREE.Quaternion(), new THREE.Quaternion(), new THREE.Matrix4()];
    this.shown.forEach((mesh, geom) => {
      if (!mesh) return;
      const position = (state) => new THREE.Vector3(...state.pos.subarray(3 * geom, 3 * geom + 3));
      const turn = (state, target) => target.setFromRotationMatrix(rotation(matrix, state.mat, 9 * geom));
      mesh.position.copy(position(before).lerp(position(now), share));
      mesh.quaternion.copy(turn(before, a).slerp(turn(now, b), share));
    });
    this.resize();
    const { renderer, canvas, inset } = this;
    renderer.setViewport(0, 0, canvas.clientWidth, canvas.clientHeight);
    renderer.clear();
    renderer.render(this.scene, this.outside);
    const frame = inset.getBoundingClientRect();
    const place = [frame.left, canvas.clientHeight - frame.bottom, frame.width, frame.height];
    renderer.setScissorTest(true);
    renderer.setScissor(...place);
    renderer.setViewport(...place);
    renderer.clear();
    renderer.render(this.scene, this.robotCamera);
    renderer.setScissorTest(false);
  }

  /** The ray of the outside camera through a place of the window. */
  ray({ clientX, clientY }) {
    const caster = new THREE.Raycaster();
    const place = [(2 * clientX) / this.canvas.clientWidth - 1, 1 - (2 * clientY) / this.canvas.clientHeight];
    caster.setFromCamera(new THREE.Vector2(...place), this.outside);
    return caster.ray;
  }

  /** How far the view has been turned about the vertical [rad]. */
  get turned() {
    return this.controls.getAzimuthalAngle() - this.firstAzimuth;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.outside.aspect === width / height && this.width === width) return;
    this.width = width;
    this.renderer.setSize(width, height, false);
    this.outside.aspect = width / height;
    const narrower = Math.max(LEAST_ASPECT / this.outside.aspect, 1);
    this.outside.fov = THREE.MathUtils.radToDeg(2 * Math.atan(narrower * HALF_HEIGHT));
    this.outside.updateProjectionMatrix();
  }
}

/** Where all geoms are, as copies that stay. */
export function poses(data) {
  return { pos: Float32Array.from(data.geom_xpos), mat: Float32Array.from(data.geom_xmat) };
}

function rotation(matrix, m, i) {
  return matrix.set(m[i], m[i + 1], m[i + 2], 0, m[i + 3], m[i + 4], m[i + 5], 0, m[i + 6], m[i + 7], m[i + 8], 0, 0, 0, 0, 1);
}

function lights() {
  const sun = new THREE.DirectionalLight(0xfff4e6, 2.6);
  sun.position.set(2.2, -2.4, 5);
  sun.target.position.set(1, 0, 0.6);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  Object.assign(sun.shadow.camera, { left: -2.8, right: 2.8, top: 2.8, bottom: -2.8, near: 1, far: 10 });
  sun.shadow.bias = -0.0005;
  sun.shadow.normalBias = 0.01;
  return [sun, sun.target, new THREE.HemisphereLight(0xffffff, 0x8d99a6, 1.6)];
}

/** The mesh of a geom; nothing of groups that are not drawn. */
function meshOf(model, geom) {
  if (!DRAWN_GROUPS.includes(model.geom_group[geom])) return null;
  const type = model.geom_type[geom];
  const [r, g, b] = model.geom_rgba.subarray(4 * geom, 4 * geom + 3);
  const color = new THREE.Color().setRGB(r, g, b, THREE.SRGBColorSpace);
  const material = new THREE.MeshStandardMaterial({ color, roughness: 0.55, metalness: 0.05 });
  if (type === PLANE) Object.assign(material, { map: checkers(), color: new THREE.Color(0xffffff), roughness: 0.9 });
  const mesh = new THREE.Mesh(shapeOf(model, geom, type), material);
  mesh.castShadow = type !== PLANE;
  mesh.receiveShadow = true;
  return mesh;
}

function shapeOf(model, geom, type) {
  const [x, y, z] = model.geom_size.subarray(3 * geom, 3 * geom + 3);
  const upright = (shape) => shape.rotateX(Math.PI / 2); // three.js has its axes along y
  switch (type) {
    case PLANE:
      return new THREE.PlaneGeometry(40, 40);
    case SPHERE:
      return new THREE.SphereGeometry(x, 32, 16);
    case CAPSULE:
      return upright(new THREE.CapsuleGeometry(x, 2 * y, 12, 32));
    case ELLIPSOID:
      return new THREE.SphereGeometry(1, 32, 16).scale(x, y, z);
    case CYLINDER:
      return upright(new THREE.CylinderGeometry(x, x, 2 * y, 40));
    case BOX:
      return new THREE.BoxGeometry(2 * x, 2 * y, 2 * z);
    case MESH:
      return meshShape(model, model.geom_dataid[geom]);
    default:
      throw new Error(`geom ${geom} is of type ${type}, which the page does not draw`);
  }
}

function meshShape(model, mesh) {
  const vertices = model.mesh_vert.subarray(3 * model.mesh_vertadr[mesh]);
  const [first, count] = [3 * model.mesh_faceadr[mesh], 3 * model.mesh_facenum[mesh]];
  const corners = Array.from(model.mesh_face.subarray(first, first + count));
  const shape = new THREE.BufferGeometry();
  const positions = corners.flatMap((corner) => Array.from(vertices.subarray(3 * corner, 3 * corner + 3)));
  shape.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  shape.computeVertexNormals();
  return shape;
}

/** Tiles of half a metre. */
function checkers() {
  const canvas = Object.assign(document.createElement("canvas"), { width: 2, height: 2 });
  const context = canvas.getContext("2d");
  ["#aab4be", "#b6bfc8", "#b6bfc8", "#aab4be"].forEach((color, i) => {
    context.fillStyle = color;
    context.fillRect(i % 2, Math.floor(i / 2), 1, 1);
  });
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.magFilter = THREE.NearestFilter;
  texture.anisotropy = 8;
  texture.repeat.set(40, 40);
  return texture;
}

/** The robot's camera: its optical axis is not in the middle of the picture. */
function pinholeCamera({ width, height, fx, fy, cx, cy, pos, quat: [w, x, y, z] }) {
  const [near, far] = [0.02, 30];
  const camera = new THREE.Camera();
  const rows = [
    [(2 * fx) / width, 0, 1 - (2 * cx) / width, 0],
    [0, (2 * fy) / height, (2 * cy) / height - 1, 0],
    [0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near)],
    [0, 0, -1, 0],
  ];
  camera.projectionMatrix.set(...rows.flat());
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.position.set(...pos);
  camera.quaternion.set(x, y, z, w).multiply(new THREE.Quaternion(1, 0, 0, 0)); // y up, z back
  return camera;
}
