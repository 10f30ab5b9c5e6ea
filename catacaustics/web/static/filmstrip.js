// Every view as a small picture with its mask and the volume's outline over it: a bad mask shows at once.

import { isEmpty } from './raster.js';

const HEIGHT = 84;

export class Filmstrip {
  constructor(element, painting) {
    this.painting = painting;
    const proposed = [...painting.views.keys()].filter((i) => painting.views[i].proposed);
    const others = [...painting.views.keys()].filter((i) => !painting.views[i].proposed);
    this.order = [...proposed, ...others];
    this.frames = new Map();
    element.append(this.group('Paint these first', proposed, true), this.group('All other views', others, false));
    this.loader = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) if (isIntersecting) this.load(this.frames.get(Number(target.dataset.view)));
    }, { root: element, rootMargin: '0px 400px' });
    for (const frame of this.frames.values()) this.loader.observe(frame.button);
    painting.addEventListener('masks', () => this.draw());
    painting.addEventListener('reports', () => this.draw());
    painting.addEventListener('reflectors', () => this.draw());
    painting.addEventListener('view', () => this.choose());
  }

  group(title, views, starred) {
    const group = document.createElement('section');
    const heading = document.createElement('h2');
    heading.textContent = title;
    const row = document.createElement('div');
    row.className = 'row';
    for (const view of views) row.append(this.frame(view, starred));
    group.append(heading, row);
    group.hidden = !views.length;
    return group;
  }

  frame(view, starred) {
    const { width, height, name, train } = this.painting.views[view];
    const button = document.createElement('button');
    button.className = 'frame';
    button.dataset.view = view;
    const canvas = document.createElement('canvas');
    const ratio = window.devicePixelRatio || 1;
    canvas.style.width = `${Math.round((HEIGHT * width) / height)}px`;
    canvas.style.height = `${HEIGHT}px`;
    canvas.width = Math.round((HEIGHT * ratio * width) / height);
    canvas.height = Math.round(HEIGHT * ratio);
    const caption = document.createElement('span');
    caption.className = 'caption';
    caption.style.width = canvas.style.width;
    const label = document.createElement('span');
    label.className = 'name';
    label.append(document.createElement('bdi'));
    label.firstChild.textContent = name.replace(/\.[^.]*$/, '');
    const badge = document.createElement('span');
    badge.className = 'badge';
    caption.append(label, badge);
    button.append(canvas, caption);
    button.title = train ? name : `${name}: held out for measuring; its mask is used only where fewer than 3 others are painted`;
    button.addEventListener('click', () => this.painting.chooseView(view));
    this.frames.set(view, { view, button, canvas, badge, starred });
    return button;
  }

  load(frame) {
    this.loader.unobserve(frame.button);
    const image = new Image();
    image.onload = () => {
      frame.image = image;
      this.drawFrame(frame);
    };
    image.src = `api/photo/${frame.view}?small`;
  }

  // The next view in the strip's order; `wanted` picks among them.
  next(step, wanted = () => true) {
    const at = this.order.indexOf(this.painting.view);
    for (let i = 1; i <= this.order.length; i++) {
      const view = this.order[(at + step * i + this.order.length * i) % this.order.length];
      if (wanted(view)) return view;
    }
    return this.painting.view;
  }

  choose() {
    for (const [view, { button }] of this.frames) {
      const current = view === this.painting.view;
      button.setAttribute('aria-current', current);
      if (current) button.scrollIntoView({ block: 'nearest', inline: 'nearest' });
    }
  }

  draw() {
    if (this.scheduled) return;
    this.scheduled = requestAnimationFrame(() => {
      this.scheduled = null;
      for (const frame of this.frames.values()) this.drawFrame(frame);
    });
  }

  drawFrame({ view, button, canvas, badge, image }) {
    const { reflector } = this.painting;
    const runs = this.painting.runs(reflector, view);
    const report = reflector?.report;
    const painted = !isEmpty(runs);
    const blamed = this.painting.blamed(reflector).includes(view);
    const fit = report?.fits[view];
    button.classList.toggle('painted', painted);
    button.classList.toggle('blamed', blamed);
    badge.textContent = blamed && fit === undefined ? '!' : fit !== undefined ? `${Math.round(fit * 100)} %` : painted ? '✓' : '';
    const state = blamed ? ', look at this mask' : painted ? ', painted' : '';
    const share = fit !== undefined ? `, the masks agree to ${Math.round(fit * 100)} %` : '';
    button.setAttribute('aria-label', `View ${this.painting.views[view].name}${state}${share}`);
    if (!image) return;
    const c = canvas.getContext('2d');
    c.clearRect(0, 0, canvas.width, canvas.height);
    c.drawImage(image, 0, 0, canvas.width, canvas.height);
    const scale = canvas.width / this.painting.views[view].width;
    for (const other of this.painting.reflectors) {
      this.drawMask(c, this.painting.runs(other, view), view, scale, other.color, other === reflector ? 0.5 : 0.25);
      const outline = other.report?.outlines?.[view];
      if (outline?.length) this.drawOutline(c, outline, scale, other === reflector ? '#ffffff' : other.color);
    }
  }

  drawMask(c, runs, view, scale, color, alpha) {
    if (isEmpty(runs)) return;
    const { width } = this.painting.views[view];
    const path = new Path2D();
    let at = 0;
    runs.forEach((length, i) => {
      // A run may go over several rows.
      for (let start = at, end = at + length; i % 2 && start < end;) {
        const y = Math.floor(start / width);
        const stop = Math.min(end, (y + 1) * width);
        path.rect((start - y * width) * scale, y * scale, (stop - start) * scale, scale);
        start = stop;
      }
      at += length;
    });
    c.globalAlpha = alpha;
    c.fillStyle = color;
    c.fill(path);
    c.globalAlpha = 1;
  }

  drawOutline(c, outline, scale, color) {
    c.beginPath();
    for (const [x, y] of outline) c.lineTo(x * scale, y * scale);
    c.closePath();
    c.lineWidth = 3 * (window.devicePixelRatio || 1);
    c.strokeStyle = 'rgba(0, 0, 0, 0.6)';
    c.stroke();
    c.lineWidth = 1.5 * (window.devicePixelRatio || 1);
    c.strokeStyle = color;
    c.stroke();
  }
}
