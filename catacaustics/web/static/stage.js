// The big picture: zoom and pan, the tools, and everything that is drawn over the photograph.
//
// Tools: 'brush', 'eraser', 'polygon', 'hand'. Coordinates named `point` are in pixels of the photograph, those named
// `place` in CSS pixels of the canvas.

import { photo } from './api.js';
import { decodeRuns, encodeRuns, fillPolygon, isEmpty, paintSegment, tint } from './raster.js';

const PHOTOS_KEPT = 6;
const PREVIEW_EVERY = 150;

export class Stage extends EventTarget {
  constructor(canvas, painting) {
    super();
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.painting = painting;
    this.tool = 'brush';
    this.radius = 12;
    this.showMask = true;
    this.showVolume = true;
    this.photos = new Map();
    this.layer = document.createElement('canvas');
    this.others = document.createElement('canvas');
    this.origin = { x: 0, y: 0 };
    this.scale = 1;
    this.corners = [];
    this.cursor = null;
    this.pointers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener('pointerdown', (e) => this.pointerDown(e));
    canvas.addEventListener('pointermove', (e) => this.pointerMove(e));
    for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, (e) => this.pointerUp(e));
    canvas.addEventListener('pointerleave', (e) => { if (!e.buttons) this.setCursor(null); });
    canvas.addEventListener('contextmenu', (e) => e.preventDefault());
    canvas.addEventListener('wheel', (e) => this.wheel(e), { passive: false });
    painting.addEventListener('masks', () => this.loadMask());
    painting.addEventListener('reports', () => this.draw());
    painting.addEventListener('reflectors', () => this.draw());
    painting.addEventListener('view', () => this.loadView());
  }

  get view() {
    return this.painting.views[this.painting.view];
  }

  // Loading ----------------------------------------------------------------------------------------------------------

  async loadView() {
    this.cancel();
    const { width, height } = this.view;
    this.layer.width = this.others.width = width;
    this.layer.height = this.others.height = height;
    this.fit();
    this.loadMask();
    const index = this.painting.view;
    if (this.photos.has(index)) return;
    try {
      const bitmap = await photo(index);
      this.photos.set(index, bitmap);
      if (this.photos.size > PHOTOS_KEPT) this.photos.delete(this.photos.keys().next().value);
    } catch (error) {
      this.dispatchEvent(new CustomEvent('problem', { detail: error }));
    }
    this.draw();
  }

  loadMask() {
    if (this.stroke) return;
    const { painting } = this;
    const { width, height } = this.view;
    this.bits = decodeRuns(painting.runs(painting.reflector, painting.view), width * height);
    this.paintLayer(this.layer, this.bits, painting.reflector?.color ?? '#ffffff');
    this.others.getContext('2d').clearRect(0, 0, width, height);
    for (const other of painting.reflectors) {
      const runs = painting.runs(other, painting.view);
      if (other === painting.reflector || isEmpty(runs)) continue;
      const layer = new OffscreenCanvas(width, height);
      this.paintLayer(layer, decodeRuns(runs, width * height), other.color);
      this.others.getContext('2d').drawImage(layer, 0, 0);
    }
    this.draw();
  }

  paintLayer(layer, bits, color, rect = { x0: 0, y0: 0, x1: layer.width, y1: layer.height }) {
    const data = new ImageData(rect.x1 - rect.x0, rect.y1 - rect.y0);
    tint(bits, layer.width, layer.height, rect, color, data.data);
    layer.getContext('2d').putImageData(data, rect.x0, rect.y0);
  }

  touch(rect) {
    if (!rect) return;
    const { width, height } = this.view;
    const wide = { x0: Math.max(rect.x0 - 1, 0), y0: Math.max(rect.y0 - 1, 0) };
    wide.x1 = Math.min(rect.x1 + 1, width);
    wide.y1 = Math.min(rect.y1 + 1, height);
    this.paintLayer(this.layer, this.bits, this.painting.reflector.color, wide);
    this.draw();
  }

  // Zoom and pan -----------------------------------------------------------------------------------------------------

  resize() {
    const { width, height } = this.canvas.getBoundingClientRect();
    if (!width) return;
    this.ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(height * this.ratio);
    const before = this.room;
    this.room = { width, height };
    if (this.zoomed && before) this.pan((width - before.width) / 2, (height - before.height) / 2);
    else this.fit();
  }

  fit() {
    if (!this.room) return;
    const { width, height } = this.view;
    this.scale = Math.min((this.room.width - 32) / width, (this.room.height - 32) / height);
    this.origin = { x: (this.room.width - width * this.scale) / 2, y: (this.room.height - height * this.scale) / 2 };
    this.zoomed = false;
    this.moved();
  }

  zoom(factor, place = { x: this.room.width / 2, y: this.room.height / 2 }) {
    const fixed = this.point(place);
    this.scale = Math.min(Math.max(this.scale * factor, 0.05), 64);
    this.origin = { x: place.x - fixed.x * this.scale, y: place.y - fixed.y * this.scale };
    this.zoomed = true;
    this.moved();
  }

  pan(dx, dy) {
    this.origin = { x: this.origin.x + dx, y: this.origin.y + dy };
    this.zoomed = true;
    this.moved();
  }

  moved() {
    this.draw();
    this.dispatchEvent(new Event('zoom'));
  }

  point(place) {
    return { x: (place.x - this.origin.x) / this.scale, y: (place.y - this.origin.y) / this.scale };
  }

  place(point) {
    return { x: point.x * this.scale + this.origin.x, y: point.y * this.scale + this.origin.y };
  }

  wheel(event) {
    event.preventDefault();
    if (event.shiftKey) this.pan(-event.deltaY - event.deltaX, 0);
    else this.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0016)), this.where(event));
  }

  where(event) {
    const box = this.canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  // Strokes ----------------------------------------------------------------------------------------------------------

  setTool(tool) {
    this.cancel();
    this.tool = tool;
    this.canvas.dataset.tool = tool;
    this.dispatchEvent(new Event('tool'));
    this.draw();
  }

  setRadius(radius) {
    this.radius = Math.min(Math.max(radius, 1), Math.max(this.view.width, this.view.height) / 3);
    this.dispatchEvent(new Event('tool'));
    this.draw();
  }

  beginStroke(point, value) {
    this.dispatchEvent(new Event('begin')); // the page may have to make a reflector first
    this.stroke = { value, last: point, previewed: performance.now() };
    this.extendStroke(point);
  }

  extendStroke(point) {
    const { width, height } = this.view;
    this.touch(paintSegment(this.bits, width, height, this.stroke.last, point, this.radius, this.stroke.value));
    this.stroke.last = point;
    const now = performance.now();
    if (now - this.stroke.previewed > PREVIEW_EVERY) {
      this.stroke.previewed = now;
      this.painting.preview(encodeRuns(this.bits));
    }
  }

  endStroke() {
    if (!this.stroke) return;
    this.stroke = null;
    this.painting.change(encodeRuns(this.bits));
    this.dispatchEvent(new Event('end'));
  }

  // Give up what is half done: the stroke or the polygon.
  cancel() {
    this.corners = [];
    if (this.stroke) {
      this.stroke = null;
      this.loadMask();
    }
    this.draw();
  }

  addCorner(point) {
    const [first] = this.corners;
    if (first && this.corners.length > 2) {
      const a = this.place(first);
      const b = this.place(point);
      if (Math.hypot(a.x - b.x, a.y - b.y) < 12) return this.closePolygon();
    }
    this.corners.push(point);
    return this.draw();
  }

  removeCorner() {
    this.corners.pop();
    this.draw();
  }

  closePolygon(value = 1) {
    const { corners } = this;
    this.corners = [];
    if (corners.length > 2) {
      this.dispatchEvent(new Event('begin'));
      const { width, height } = this.view;
      this.touch(fillPolygon(this.bits, width, height, corners, value));
      this.painting.change(encodeRuns(this.bits));
    }
    this.draw();
  }

  // Pointers: mouse, pen, one finger paints, two fingers zoom and pan ---------------------------------------------------

  pointerDown(event) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    const place = this.where(event);
    this.pointers.set(event.pointerId, place);
    if (event.pointerType === 'pen') this.penSeen = true;
    if (event.pointerType === 'touch' && this.pointers.size === 2) {
      this.cancel();
      this.mode = 'pinch';
      return;
    }
    if (this.pointers.size > 1) return;
    const palm = event.pointerType === 'touch' && this.penSeen; // with a pen at hand, fingers only move the picture
    if (event.button === 1 || this.tool === 'hand' || palm) {
      this.mode = 'pan';
      return;
    }
    this.setCursor(this.point(place));
    if (this.tool === 'polygon') {
      this.mode = null;
      if (event.button === 2) this.closePolygon();
      else this.addCorner(this.cursor);
      return;
    }
    this.mode = 'stroke';
    const erases = this.tool === 'eraser' || event.button === 2 || event.buttons & 32; // 32: a pen's eraser
    this.beginStroke(this.cursor, erases ? 0 : 1);
  }

  pointerMove(event) {
    const place = this.where(event);
    const before = this.pointers.get(event.pointerId);
    if (before && this.mode === 'pan') this.pan(place.x - before.x, place.y - before.y);
    if (before && this.mode === 'pinch') this.pinch(event.pointerId, place);
    if (before && this.mode === 'stroke' && this.stroke) {
      for (const part of event.getCoalescedEvents?.() ?? [event]) this.extendStroke(this.point(this.where(part)));
      this.extendStroke(this.point(place));
    }
    if (before) this.pointers.set(event.pointerId, place);
    if (event.pointerType !== 'touch' || this.mode === 'stroke') this.setCursor(this.point(place));
  }

  pinch(id, place) {
    const before = this.pointers.get(id);
    const other = [...this.pointers].find(([key]) => key !== id)?.[1];
    if (!other) return;
    const apart = (a, b) => Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1);
    const middle = { x: (before.x + other.x) / 2, y: (before.y + other.y) / 2 };
    this.zoom(apart(place, other) / apart(before, other), middle);
    this.pan((place.x - before.x) / 2, (place.y - before.y) / 2);
  }

  pointerUp(event) {
    this.pointers.delete(event.pointerId);
    if (event.type === 'pointercancel') this.cancel();
    else if (this.mode === 'stroke') this.endStroke();
    if (!this.pointers.size) this.mode = null;
    if (event.pointerType === 'touch') this.setCursor(null);
  }

  setCursor(point, keyboard = false) {
    this.cursor = point;
    this.keyboard = keyboard;
    this.draw();
  }

  // Keyboard: a cursor that arrow keys move; with the pen down it paints ------------------------------------------------

  moveCursor(dx, dy) {
    const { width, height } = this.view;
    const from = this.cursor ?? { x: width / 2, y: height / 2 };
    const to = { x: from.x + dx / this.scale, y: from.y + dy / this.scale };
    to.x = Math.min(Math.max(to.x, 0), width);
    to.y = Math.min(Math.max(to.y, 0), height);
    if (this.stroke) this.extendStroke(to);
    const place = this.place(to);
    const inset = (at, room) => Math.min(Math.max(at, 24), room - 24);
    const shift = { x: inset(place.x, this.room.width) - place.x, y: inset(place.y, this.room.height) - place.y };
    if (this.zoomed && (shift.x || shift.y)) this.pan(shift.x, shift.y);
    this.setCursor(to, true);
  }

  penDown() {
    if (this.stroke || this.tool === 'hand') return;
    if (!this.cursor) this.moveCursor(0, 0);
    this.keyboard = true;
    if (this.tool === 'polygon') this.addCorner(this.cursor);
    else this.beginStroke(this.cursor, this.tool === 'eraser' ? 0 : 1);
  }

  penUp() {
    this.endStroke();
  }

  // Drawing ----------------------------------------------------------------------------------------------------------

  draw() {
    if (this.scheduled) return;
    this.scheduled = requestAnimationFrame(() => {
      this.scheduled = null;
      if (this.room && this.bits) this.drawNow();
    });
  }

  drawNow() {
    const { context: c, painting, view, ratio } = this;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, this.room.width, this.room.height);
    const { x, y } = this.origin;
    const [w, h] = [view.width * this.scale, view.height * this.scale];
    c.imageSmoothingEnabled = this.scale < 3;
    c.fillStyle = '#0d0f11';
    c.fillRect(x, y, w, h);
    const bitmap = this.photos.get(painting.view);
    if (bitmap) c.drawImage(bitmap, x, y, w, h);
    if (this.showMask) {
      c.globalAlpha = 0.45;
      c.drawImage(this.others, x, y, w, h);
      c.globalAlpha = 1;
      c.drawImage(this.layer, x, y, w, h);
    }
    if (this.showVolume) {
      c.save();
      c.beginPath();
      c.rect(x, y, w, h);
      c.clip();
      for (const reflector of painting.reflectors) {
        const outline = reflector.report?.outlines?.[painting.view];
        if (outline?.length) this.drawOutline(outline, reflector === painting.reflector ? '#ffffff' : reflector.color);
      }
      c.restore();
    }
    if (this.corners.length) this.drawPolygon();
    if (this.cursor) this.drawCursor();
  }

  drawOutline(outline, color) {
    const { context: c } = this;
    c.beginPath();
    for (const [px, py] of outline) c.lineTo(px * this.scale + this.origin.x, py * this.scale + this.origin.y);
    c.closePath();
    c.lineJoin = 'round';
    c.strokeStyle = 'rgba(0, 0, 0, 0.65)';
    c.lineWidth = 4;
    c.stroke();
    c.strokeStyle = color;
    c.lineWidth = 1.75;
    c.setLineDash([7, 4]);
    c.stroke();
    c.setLineDash([]);
  }

  drawPolygon() {
    const { context: c } = this;
    const places = this.corners.map((p) => this.place(p));
    c.beginPath();
    for (const p of places) c.lineTo(p.x, p.y);
    if (this.cursor) {
      const p = this.place(this.cursor);
      c.lineTo(p.x, p.y);
    }
    c.strokeStyle = 'rgba(0, 0, 0, 0.7)';
    c.lineWidth = 4;
    c.stroke();
    c.strokeStyle = this.painting.reflector?.color ?? '#fff';
    c.lineWidth = 2;
    c.stroke();
    places.forEach((p, i) => {
      c.beginPath();
      c.arc(p.x, p.y, i ? 3.5 : 6, 0, 7);
      c.fillStyle = i ? '#fff' : this.painting.reflector?.color ?? '#fff';
      c.fill();
      c.strokeStyle = 'rgba(0, 0, 0, 0.8)';
      c.lineWidth = 1.5;
      c.stroke();
    });
  }

  drawCursor() {
    const { context: c } = this;
    const p = this.place(this.cursor);
    const ring = (radius, dark) => {
      c.beginPath();
      c.arc(p.x, p.y, radius, 0, 7);
      c.strokeStyle = dark ? 'rgba(0, 0, 0, 0.7)' : '#fff';
      c.lineWidth = dark ? 3 : 1.25;
      c.stroke();
    };
    if (this.tool === 'brush' || this.tool === 'eraser') {
      const radius = Math.max(this.radius * this.scale, 1.5);
      if (this.tool === 'eraser') c.setLineDash([4, 4]);
      ring(radius, true);
      ring(radius, false);
      c.setLineDash([]);
    }
    if (!this.keyboard) return;
    for (const [style, width] of [['rgba(0, 0, 0, 0.8)', 4], ['#fff', 1.5]]) {
      c.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        c.moveTo(p.x + 4 * dx, p.y + 4 * dy);
        c.lineTo(p.x + 12 * dx, p.y + 12 * dy);
      }
      c.strokeStyle = style;
      c.lineWidth = width;
      c.stroke();
    }
  }
}
