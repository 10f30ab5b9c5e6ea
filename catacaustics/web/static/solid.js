// The volumes and the cameras in space, seen from a camera that goes round them. Drag or arrow keys turn it, the wheel
// zooms, a click on a camera chooses its view.

import { parseColor } from './raster.js';

const sub = (a, b) => a.map((v, i) => v - b[i]);
const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / (Math.hypot(...a) || 1));

export class Solid {
  constructor(canvas, painting, { target, up, reach }) {
    this.canvas = canvas;
    this.painting = painting;
    this.target = target;
    this.up = unit(up);
    this.reach = reach;
    const side = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.east = unit(cross(side, this.up));
    this.north = cross(this.up, this.east);
    this.turn = 0.6;
    this.tilt = 0.5;
    this.distance = 3;
    this.turning = !matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.listen();
    for (const name of ['reports', 'view', 'reflectors']) painting.addEventListener(name, () => this.draw());
    new ResizeObserver(() => this.draw()).observe(canvas);
    const step = (now) => {
      if (this.turning && !document.hidden && now - (this.last ?? 0) > 50) {
        this.turn += Math.min((now - (this.last ?? now)) / 1000, 0.1) * 0.25;
        this.last = now;
        this.drawNow();
      }
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener('pointerdown', (e) => {
      canvas.setPointerCapture(e.pointerId);
      this.turning = false;
      this.drag = { x: e.clientX, y: e.clientY, moved: 0 };
    });
    canvas.addEventListener('pointermove', (e) => {
      if (!this.drag) return;
      const [dx, dy] = [e.clientX - this.drag.x, e.clientY - this.drag.y];
      this.drag = { x: e.clientX, y: e.clientY, moved: this.drag.moved + Math.abs(dx) + Math.abs(dy) };
      this.rotate(-dx * 0.01, dy * 0.01);
    });
    canvas.addEventListener('pointerup', (e) => {
      if (this.drag && this.drag.moved < 4) this.pick(e);
      this.drag = null;
    });
    canvas.addEventListener('wheel', (e) => {
      e.preventDefault();
      this.distance = Math.min(Math.max(this.distance * Math.exp(e.deltaY * 0.001), 0.3), 8);
      this.draw();
    }, { passive: false });
    canvas.addEventListener('keydown', (e) => {
      const turns = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
      if (!turns) return;
      e.preventDefault();
      e.stopPropagation();
      this.turning = false;
      this.rotate(...turns);
    });
  }

  rotate(turn, tilt) {
    this.turn += turn;
    this.tilt = Math.min(Math.max(this.tilt + tilt, -1.5), 1.5);
    this.draw();
  }

  pick(event) {
    const box = this.canvas.getBoundingClientRect();
    let best = 18;
    let chosen = null;
    this.painting.views.forEach((view, i) => {
      const p = this.project(view.center);
      const far = p ? Math.hypot(p.x - (event.clientX - box.left), p.y - (event.clientY - box.top)) : Infinity;
      if (far < best) [best, chosen] = [far, i];
    });
    if (chosen !== null) this.painting.chooseView(chosen);
  }

  setUp() {
    const flat = this.east.map((v, i) => v * Math.cos(this.turn) + this.north[i] * Math.sin(this.turn));
    const out = flat.map((v, i) => v * Math.cos(this.tilt) + this.up[i] * Math.sin(this.tilt));
    this.forward = out.map((v) => -v);
    this.right = unit(cross(this.forward, this.up));
    this.down = cross(this.forward, this.right);
    this.eye = this.target.map((v, i) => v + out[i] * this.distance * this.reach);
  }

  project(point) {
    const p = sub(point, this.eye);
    const z = dot(p, this.forward);
    if (z < 0.02 * this.reach) return null;
    const focal = 1.25 * Math.min(this.width, this.height);
    return { x: this.width / 2 + (focal * dot(p, this.right)) / z, y: this.height / 2 + (focal * dot(p, this.down)) / z, z };
  }

  draw() {
    if (this.scheduled) return;
    this.scheduled = requestAnimationFrame(() => {
      this.scheduled = null;
      this.drawNow();
    });
  }

  drawNow() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const box = canvas.getBoundingClientRect();
    if (!box.width) return;
    [this.width, this.height] = [box.width, box.height];
    canvas.width = Math.round(box.width * ratio);
    canvas.height = Math.round(box.height * ratio);
    const c = canvas.getContext('2d');
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.lineJoin = 'round';
    this.setUp();
    // Cameras behind the object first, then the object, then the cameras before it.
    const depth = dot(sub(this.target, this.eye), this.forward);
    this.painted = new Set(this.painting.painted(this.painting.reflector));
    const parts = this.painting.views.map((view, i) => ({ z: this.project(view.center)?.z, draw: () => this.drawCamera(c, view, i) }));
    for (const reflector of this.painting.reflectors) {
      const { mesh } = reflector.report ?? {};
      if (mesh) parts.push({ z: this.project(mesh.vertices[0])?.z ?? depth, draw: () => this.drawMesh(c, mesh, reflector) });
    }
    parts.filter((p) => p.z).sort((a, b) => b.z - a.z).forEach((p) => p.draw());
  }

  drawCamera(c, view, index) {
    const tip = this.project(view.center);
    const corners = view.corners.map((corner) => this.project(corner));
    if (!tip || corners.some((p) => !p)) return;
    const { reflector } = this.painting;
    const current = index === this.painting.view;
    const painted = this.painted.has(index);
    c.beginPath();
    corners.forEach((p, i) => {
      const next = corners[(i + 1) % 4];
      c.moveTo(tip.x, tip.y);
      c.lineTo(p.x, p.y);
      c.lineTo(next.x, next.y);
    });
    c.strokeStyle = current ? '#ffffff' : painted ? reflector.color : view.proposed ? 'rgba(200, 208, 218, 0.75)' : 'rgba(150, 160, 172, 0.32)';
    c.lineWidth = current ? 2 : painted ? 1.6 : 1;
    c.stroke();
  }

  drawMesh(c, { vertices, faces }, reflector) {
    const pixels = vertices.map((v) => this.project(v));
    const color = parseColor(reflector.color);
    const light = unit(this.up.map((v, i) => 0.8 * v - 0.6 * this.forward[i] - 0.4 * this.right[i]));
    for (const face of faces) {
      const [a, b, d] = face.map((i) => vertices[i]);
      const normal = unit(cross(sub(b, a), sub(d, a)));
      if (dot(normal, sub(a, this.eye)) >= 0 || face.some((i) => !pixels[i])) continue;
      const shade = 0.45 + 0.55 * Math.max(dot(normal, light), 0);
      c.beginPath();
      for (const i of face) c.lineTo(pixels[i].x, pixels[i].y);
      c.closePath();
      c.fillStyle = c.strokeStyle = `rgb(${color.map((v) => Math.round(v * shade)).join(' ')})`;
      c.lineWidth = 0.7; // hides the seams between faces
      c.fill();
      c.stroke();
    }
  }
}
