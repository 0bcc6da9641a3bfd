/** Throwing with the mouse: drag the object where it shall fly; the arc shows its path. */

import * as THREE from "three";

const SPEED_PER_METRE = 5; // speed of the throw over the way that is dragged [1/s]
const LEAST_SPEED = 1; // slower is no throw [m/s]
const [NEAREST, LOWEST] = [1.2, 0.3]; // from where one can throw at all, x and z [m]
const GRASP = 0.15; // how near to the object a drag may begin [m]
const PRACTISED = 0x14804a;
const UNPRACTISED = 0xc97a10;
const EXAMPLE = 0x9aa5b1;

export class Aiming {
  /**
   * @param {import("./view.js").View} view
   * @param {object} task of task.json
   * @param {(velocity: number[]) => void} thrown called with the velocity at release [m/s]
   * @param {(position: number[]) => void} moved called where the object is dragged to with Shift held [m]
   */
  constructor(view, task, { thrown, moved }) {
    Object.assign(this, { view, task, thrown, moved, isOpen: false, velocity: null });
    this.arc = view.addMark(new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial()));
    this.mark = view.addMark(new THREE.Mesh(new THREE.TorusGeometry(0.09, 0.008, 8, 40), new THREE.MeshBasicMaterial()));
    this.hide();
    const { canvas } = view;
    canvas.addEventListener("pointerdown", (event) => this.grasp(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.letGo(event));
  }

  /** Let an object be thrown from where a throw begins, whose path is shown as an example; or nothing. */
  open(example) {
    this.isOpen = example !== null;
    this.hide();
    if (!example) return;
    this.position = new THREE.Vector3(...example.pos);
    this.showPath(new THREE.Vector3(...example.linVel), EXAMPLE);
  }

  grasp(event) {
    if (!this.isOpen || this.view.ray(event).distanceToPoint(this.position) > GRASP) return;
    this.view.controls.enabled = false;
    this.view.canvas.setPointerCapture(event.pointerId);
    this.isDragging = true;
  }

  drag(event) {
    const near = this.isOpen && this.view.ray(event).distanceToPoint(this.position) < GRASP;
    this.view.canvas.style.cursor = this.isDragging ? "grabbing" : near ? "grab" : "";
    if (!this.isDragging) return;
    const place = this.view.ray(event).intersectPlane(this.plane(), new THREE.Vector3());
    if (!place) return;
    if (event.shiftKey) {
      this.position.set(Math.max(place.x, NEAREST), place.y, Math.max(place.z, LOWEST));
      this.hide();
      this.moved(this.position.toArray());
    } else {
      this.velocity = place.sub(this.position).multiplyScalar(SPEED_PER_METRE);
      this.showPath(this.velocity);
    }
  }

  letGo() {
    if (!this.isDragging) return;
    this.isDragging = false;
    this.view.controls.enabled = true;
    const { velocity } = this;
    this.hide();
    if (velocity?.length() > LEAST_SPEED) this.thrown(velocity.toArray());
  }

  hide() {
    this.velocity = null;
    this.arc.visible = this.mark.visible = false;
  }

  /** The vertical plane towards the catch area; turning the view turns it, too. */
  plane() {
    const [x, y] = this.catchCenter();
    const angle = Math.atan2(y - this.position.y, x - this.position.x) + this.view.turned;
    const normal = new THREE.Vector3(-Math.sin(angle), Math.cos(angle), 0);
    return new THREE.Plane().setFromNormalAndCoplanarPoint(normal, this.position);
  }

  catchCenter() {
    const middle = ([lower, upper]) => (lower + upper) / 2;
    return ["aim_x", "aim_y", "aim_z"].map((name) => middle(this.task.throws[name]));
  }

  /** The path of a throw, in a colour or in green where the policy has practised it. */
  showPath(velocity, color = null) {
    const { throws, physics } = this.task;
    const [p, v] = [this.position, velocity];
    const height = this.catchCenter()[2];
    const root = v.z ** 2 - 2 * physics.gravity * (height - p.z);
    const duration = root > 0 && v.z > 0 ? (v.z + Math.sqrt(root)) / physics.gravity : 0.6;
    const fall = (t) => new THREE.Vector3(0, 0, -(physics.gravity * t * t) / 2);
    const at = (t) => p.clone().addScaledVector(v, t).add(fall(t));
    const end = at(duration);
    const peak = p.z + Math.max(v.z, 0) ** 2 / (2 * physics.gravity);
    const isWithin = (value, [lower, upper], margin) => value > lower - margin && value < upper + margin;
    const isPractised =
      isWithin(end.x, throws.aim_x, 0.05) && isWithin(end.y, throws.aim_y, 0.05) && isWithin(peak, throws.peak_z, 0.2);
    const path = new THREE.CatmullRomCurve3(Array.from({ length: 25 }, (_, i) => at((duration * i) / 24)));
    this.arc.geometry.dispose();
    this.arc.geometry = new THREE.TubeGeometry(path, 48, 0.006, 6);
    this.mark.position.copy(end);
    for (const { material } of [this.arc, this.mark]) {
      material.color.set(color ?? (isPractised ? PRACTISED : UNPRACTISED));
    }
    this.arc.visible = this.mark.visible = true;
  }
}
