// The document: reflectors, their masks, undo, saving, drafts. No drawing here.
//
// Events: 'masks' (a mask changed), 'reports' (a volume changed), 'reflectors' (names, colours, choice), 'view',
// 'status' (saved or not), 'conflict' (a mask changed elsewhere; detail: reflector, view, theirs).

import { get, post } from './api.js';
import { isEmpty, sameRuns } from './raster.js';

const UNDO_STEPS = 300;
const RETRY = 4000;

export class Painting extends EventTarget {
  constructor(state) {
    super();
    this.id = state.id;
    this.views = state.views;
    this.reflectors = [];
    this.reflector = null;
    this.view = 0;
    this.done = [];
    this.undone = [];
    this.problem = null;
    this.unnoted = false;
    this.saving = false;
  }

  emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // Reflectors -------------------------------------------------------------------------------------------------------

  async load(reflectors) {
    for (const { name, color } of reflectors) {
      const reflector = this.makeReflector(name, color);
      this.fill(reflector, await get(`masks?reflector=${encodeURIComponent(name)}`));
    }
    this.restoreDrafts();
    this.reflector = this.reflectors[0] ?? null;
    this.emit('reflectors');
    this.emit('masks');
    await Promise.all(this.reflectors.map((r) => this.refresh(r)));
    this.flush();
  }

  makeReflector(name, color) {
    const reflector = { name, color, masks: new Map(), report: null, asked: 0, answered: 0 };
    this.reflectors.push(reflector);
    return reflector;
  }

  fill(reflector, masks) {
    for (const [view, { runs, revision }] of Object.entries(masks)) {
      reflector.masks.set(Number(view), { runs, revision, saved: true });
    }
  }

  addReflector(name, color) {
    this.reflector = this.makeReflector(name, color);
    this.emit('reflectors');
    this.emit('masks');
    this.noteReflectors();
  }

  noteReflectors() {
    this.unnoted = true;
    this.flush();
  }

  async note() {
    this.unnoted = false;
    try {
      await post('reflectors', { reflectors: Object.fromEntries(this.reflectors.map((r) => [r.name, r.color])) });
    } catch (error) {
      this.unnoted = true;
      throw error;
    }
  }

  chooseReflector(reflector) {
    this.reflector = reflector;
    this.emit('reflectors');
    this.emit('masks');
    this.emit('reports');
  }

  async renameReflector(reflector, name) {
    await this.settled();
    const { report } = await post('rename', { from: reflector.name, to: name });
    reflector.name = name;
    this.accept(reflector, ++reflector.asked, report);
    this.emit('reflectors');
  }

  async deleteReflector(reflector) {
    await this.settled();
    const { kept } = await post('delete', { name: reflector.name });
    this.reflectors = this.reflectors.filter((r) => r !== reflector);
    for (const stack of ['done', 'undone']) this[stack] = this[stack].filter((step) => step.reflector !== reflector);
    this.chooseReflector(this.reflectors[0] ?? null);
    return kept;
  }

  recolor(reflector, color) {
    reflector.color = color;
    this.emit('reflectors');
    this.emit('masks');
    this.noteReflectors();
  }

  // Masks and undo ---------------------------------------------------------------------------------------------------

  chooseView(view) {
    this.view = Math.min(Math.max(view, 0), this.views.length - 1);
    this.emit('view');
  }

  size(view) {
    return this.views[view].width * this.views[view].height;
  }

  runs(reflector, view) {
    return reflector?.masks.get(view)?.runs ?? [this.size(view)];
  }

  painted(reflector) {
    return reflector ? [...reflector.masks].filter(([, mask]) => !isEmpty(mask.runs)).map(([view]) => view) : [];
  }

  // Views whose masks are to be looked at; that one mask alone bounds nothing is nobody's fault.
  blamed(reflector) {
    const alone = this.painted(reflector).length === 1 && !reflector.report?.problem?.found.includes(' is all ');
    return alone ? [] : reflector?.report?.problem?.views ?? [];
  }

  change(runs, reflector = this.reflector, view = this.view) {
    const before = this.runs(reflector, view);
    if (sameRuns(before, runs)) return;
    this.done.push({ reflector, view, before, after: runs });
    if (this.done.length > UNDO_STEPS) this.done.shift();
    this.undone = [];
    this.put(reflector, view, runs);
  }

  undo() {
    this.step(this.done, this.undone, 'before');
  }

  redo() {
    this.step(this.undone, this.done, 'after');
  }

  step(from, to, side) {
    const step = from.pop();
    if (!step) return;
    to.push(step);
    if (step.reflector !== this.reflector) this.chooseReflector(step.reflector);
    if (step.view !== this.view) this.chooseView(step.view);
    this.put(step.reflector, step.view, step[side]);
  }

  put(reflector, view, runs) {
    const revision = reflector.masks.get(view)?.revision ?? 'empty';
    reflector.masks.set(view, { runs, revision, saved: false });
    this.keepDraft(reflector, view);
    this.emit('masks');
    this.flush();
  }

  // Saving -----------------------------------------------------------------------------------------------------------

  unsaved() {
    return this.reflectors.flatMap((reflector) =>
      [...reflector.masks].filter(([, mask]) => !mask.saved).map(([view, mask]) => ({ reflector, view, mask })));
  }

  async flush() {
    clearTimeout(this.retry);
    this.again = true;
    if (this.saving) return;
    this.saving = true;
    this.emit('status');
    try {
      while (this.again) {
        this.again = false;
        await this.saveAll();
      }
    } finally {
      this.saving = false;
      this.emit('status');
    }
    if (this.problem) this.retry = setTimeout(() => this.flush(), RETRY);
  }

  async saveAll() {
    if (await this.trySaving()) return;
    if (!this.problem.status) return;
    // The server runs, but cannot write: it can still say what the masks make.
    for (const reflector of new Set(this.unsaved().map((u) => u.reflector))) await this.refresh(reflector);
  }

  async trySaving() {
    if (this.unnoted && !(await this.attempt(() => this.note()))) return false;
    let next;
    while ((next = this.unsaved().find(({ mask }) => !mask.conflict))) {
      if (!(await this.attempt(() => this.saveMask(next.reflector, next.view, next.mask)))) return false;
    }
    return true;
  }

  // Wait until nothing is being saved; throws where something cannot be.
  async settled() {
    await this.flush();
    while (this.saving) await new Promise((resolve) => setTimeout(resolve, 30));
    if (this.unsaved().length) throw this.problem ?? new Error('A mask is not saved yet.');
  }

  async attempt(work) {
    try {
      await work();
      this.problem = null;
      return true;
    } catch (error) {
      if (error.status === undefined) throw error;
      this.problem = error;
      return false;
    } finally {
      this.emit('status');
    }
  }

  async saveMask(reflector, view, mask) {
    const asked = ++reflector.asked;
    try {
      const body = { reflector: reflector.name, view, runs: mask.runs, revision: mask.revision };
      const { revision, report } = await post('save', body);
      const current = reflector.masks.get(view);
      current.revision = revision;
      if (current.runs === mask.runs) {
        current.saved = true;
        this.dropDraft(reflector, view);
      }
      this.accept(reflector, asked, report);
    } catch (error) {
      if (error.status !== 409) throw error;
      mask.conflict = true;
      this.emit('conflict', { reflector, view, theirs: { runs: error.runs, revision: error.revision } });
    }
  }

  // End a conflict: keep this page's mask, or take the other one (ours can be had back by undo).
  resolve({ reflector, view, theirs }, keepOurs) {
    const ours = this.runs(reflector, view);
    if (!keepOurs) this.done.push({ reflector, view, before: ours, after: theirs.runs });
    reflector.masks.set(view, { runs: keepOurs ? ours : theirs.runs, revision: theirs.revision, saved: !keepOurs });
    if (!keepOurs) this.dropDraft(reflector, view);
    this.emit('masks');
    this.refresh(reflector);
    this.flush();
  }

  // Masks that changed on disk while this page had no changes of its own.
  async catchUp() {
    for (const reflector of this.reflectors) {
      const found = await get(`masks?reflector=${encodeURIComponent(reflector.name)}`).catch(() => null);
      if (!found) return;
      let changed = false;
      for (const view of new Set([...reflector.masks.keys(), ...Object.keys(found).map(Number)])) {
        const theirs = found[view] ?? { runs: [this.size(view)], revision: 'empty' };
        const ours = reflector.masks.get(view);
        if ((ours && !ours.saved) || (ours?.revision ?? 'empty') === theirs.revision) continue;
        reflector.masks.set(view, { ...theirs, saved: true });
        changed = true;
      }
      if (changed) {
        this.emit('masks');
        await this.refresh(reflector);
      }
    }
  }

  // Drafts: what is not on the server's disk yet stays in this browser, whatever happens to the page or the server.

  key(reflector, view) {
    return `catacaustics:${this.id}:${view}:${reflector.name}`;
  }

  keepDraft(reflector, view) {
    const { runs, revision } = reflector.masks.get(view);
    try {
      localStorage.setItem(this.key(reflector, view), JSON.stringify({ runs, revision, color: reflector.color }));
    } catch { /* the browser's store is full or switched off: the page still holds the mask */ }
  }

  dropDraft(reflector, view) {
    localStorage.removeItem(this.key(reflector, view));
  }

  restoreDrafts() {
    const start = `catacaustics:${this.id}:`;
    for (const key of Object.keys(localStorage).filter((k) => k.startsWith(start))) {
      const [view, ...rest] = key.slice(start.length).split(':');
      const draft = JSON.parse(localStorage.getItem(key));
      if (!this.views[view]) continue;
      const name = rest.join(':');
      const reflector = this.reflectors.find((r) => r.name === name) ?? this.makeReflector(name, draft.color);
      // Its old revision goes along: where the mask on disk is another one by now, saving reports the conflict.
      reflector.masks.set(Number(view), { runs: draft.runs, revision: draft.revision, saved: false });
      this.restored = (this.restored ?? 0) + 1;
    }
  }

  // Volumes ----------------------------------------------------------------------------------------------------------

  // Ask for the volume of the masks as they are here, saved or not; `stroke` replaces the mask in the current view.
  async refresh(reflector, stroke) {
    const asked = ++reflector.asked;
    const masks = {};
    for (const [view, mask] of reflector.masks) if (!mask.saved) masks[view] = mask.runs;
    if (stroke) masks[this.view] = stroke;
    try {
      this.accept(reflector, asked, await post('report', { reflector: reflector.name, masks }));
    } catch (error) {
      if (error.status === undefined) throw error;
    }
  }

  async preview(stroke) {
    if (this.previewing) return;
    this.previewing = true;
    await this.refresh(this.reflector, stroke);
    this.previewing = false;
  }

  accept(reflector, asked, report) {
    if (asked < reflector.answered) return;
    reflector.answered = asked;
    reflector.report = report;
    this.emit('reports');
  }
}
