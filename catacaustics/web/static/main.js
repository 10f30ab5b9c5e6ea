// Puts the painter together: buttons, keys, dialogs, words.

import { get, post } from './api.js';
import { Filmstrip } from './filmstrip.js';
import { Painting } from './painting.js';
import { coverage } from './raster.js';
import { Solid } from './solid.js';
import { Stage } from './stage.js';

const COLORS = ['#f5b83d', '#4cc3ff', '#ff7eb6', '#7ee081', '#b69cff', '#ff9466', '#5de0d0', '#e6e05c'];
const KEYS = [
  ['Brush, eraser', 'B', 'E'], ['Polygon', 'P'], ['Move the picture', 'H'],
  ['Smaller, larger brush', '[', ']'], ['Outline a scribble', 'G'], ['… by colour (GrabCut)', 'Shift G'],
  ['Undo', 'Ctrl Z'], ['Redo', 'Ctrl Shift Z'], ['Clear this view', 'Delete'],
  ['Previous, next view', ',', '.'], ['Next view to paint', 'N'], ['Choose a reflector', '1', '…', '9'], ['Add a reflector', 'A'],
  ['Zoom', '+', '−', '0'], ['Show masks, volume', 'M', 'V'],
  ['Move the cursor', '←', '↑', '→', '↓'], ['in large steps', 'Shift ←'],
  ['Paint at the cursor', 'Space'], ['Polygon: corner, close', 'Space', 'Enter'],
  ['Polygon: last corner, give up', 'Backspace', 'Esc'], ['These keys', '?'],
];

const $ = (id) => document.getElementById(id);
const state = await get('state').catch((error) => {
  showProblem(error);
  throw error;
});
const painting = new Painting(state);
const stage = new Stage($('stage'), painting);
const filmstrip = new Filmstrip($('filmstrip'), painting);
new Solid($('solid'), painting, state);

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

// Words ---------------------------------------------------------------------------------------------------------------

function showProblem(problem) {
  $('banner').hidden = !problem;
  if (!problem) return;
  const rest = [problem.expected && `Expected: ${problem.expected}.`, problem.remedy && `What to do: ${problem.remedy}.`];
  $('banner').querySelector('p').replaceChildren(
    problem.found ?? problem.message, element('small', { textContent: rest.filter(Boolean).join(' ') }));
}

function showStatus() {
  const count = painting.unsaved().length;
  const open = count || painting.unnoted;
  const status = painting.problem && open ? 'unsaved' : painting.saving || open ? 'saving' : 'saved';
  $('status').dataset.state = status;
  const words = { saved: 'All saved', saving: 'Saving…', unsaved: `Not saved${count ? `: ${count} ${count === 1 ? 'mask' : 'masks'}` : ''}` };
  $('status').querySelector('span').textContent = words[status];
  showProblem(painting.problem);
}

function showAdvice() {
  if (stage.stroke) return; // half a stroke is not a mistake
  const { reflector } = painting;
  const count = painting.painted(reflector).length;
  const report = reflector?.report;
  const advice = advise(reflector, count, report);
  $('advice').dataset.state = advice.state;
  const jumps = (advice.views ?? []).slice(0, 6).map((view) =>
    element('button', { textContent: painting.views[view].name, onclick: () => painting.chooseView(view) }));
  const parts = [element('h3', { textContent: advice.title }), element('p', { textContent: advice.text })];
  if (jumps.length) parts.push(element('div', { className: 'jump' }, ...jumps));
  $('advice').replaceChildren(...parts);
  const { radius } = report?.mesh ?? {};
  $('facts').textContent = radius ? `${count} ${count === 1 ? 'mask' : 'masks'}, radius ${radius.toPrecision(3)}` : '';
}

function advise(reflector, count, report) {
  const proposed = [...painting.views.keys()].filter((i) => painting.views[i].proposed);
  const left = proposed.filter((i) => !painting.painted(reflector).includes(i));
  if (!count) {
    return {
      state: 'start', title: `Paint ${reflector ? reflector.name : 'the reflector'} in ${proposed.length} views`,
      text: 'Begin with this one. A few pixels too wide is better than too tight; or scribble over it and press G.',
    };
  }
  const problem = report?.problem;
  if (problem && count === 1 && !painting.blamed(reflector).length) {
    return { state: 'start', title: 'One view painted', text: 'Two more from other sides bound the volume.', views: left };
  }
  if (problem) return { state: 'warn', title: problem.found, text: `${capital(problem.remedy)}.`, views: problem.views };
  if (!report) return { state: 'start', title: 'Computing the volume', text: '' };
  if (count < 3) {
    return { state: 'start', title: 'Paint one or two more views', text: 'The dashed line shows what the masks leave together.', views: left };
  }
  const worst = Math.min(...Object.values(report.fits));
  const title = `The masks agree to ${Math.round(worst * 100)}\u00a0%`;
  if (count === 3 && left.length) {
    return { state: 'good', title, text: 'One more view from another side makes the volume tighter.', views: left };
  }
  return {
    state: 'good', title,
    text: 'Look through other views: the dashed line should hold the whole object, closely. If it does, this reflector is done.',
  };
}

const capital = (text) => text[0].toUpperCase() + text.slice(1);

function showView() {
  const view = painting.views[painting.view];
  $('view-name').textContent = view.name;
  const share = coverage(painting.runs(painting.reflector, painting.view));
  const mask = share ? `, mask ${(share * 100).toPrecision(2)} %` : '';
  $('view-note').textContent = `${painting.view + 1} of ${painting.views.length}${view.train ? '' : ', held out'}${mask}`;
}

function showTools() {
  for (const button of document.querySelectorAll('[data-tool]')) {
    if (button.localName === 'button') button.setAttribute('aria-pressed', button.dataset.tool === stage.tool);
  }
  const { width, height } = painting.views[painting.view];
  $('radius').value = 100 * Math.sqrt((stage.radius - 1) / (Math.max(width, height) / 4));
  $('radius-shown').textContent = `${Math.round(2 * stage.radius)} px`;
  $('fit').textContent = `${Math.round(stage.scale * 100)} %`;
  $('undo').disabled = !painting.done.length;
  $('redo').disabled = !painting.undone.length;
}

function showReflectors() {
  const pencil = '<svg viewBox="0 0 24 24"><path d="m4 20 1-4.5L16.5 4l3.5 3.5L8.5 19 4 20Z"/></svg>';
  const bin = '<svg viewBox="0 0 24 24"><path d="m6 6 12 12M18 6 6 18"/></svg>';
  const rows = painting.reflectors.map((reflector) => {
    const count = painting.painted(reflector).length;
    const row = element('li', {},
      element('input', { type: 'color', value: reflector.color, title: 'Colour', ariaLabel: `Colour of ${reflector.name}`,
        onchange: (e) => painting.recolor(reflector, e.target.value) }),
      element('button', { className: 'choose', onclick: () => painting.chooseReflector(reflector), ondblclick: () => rename(reflector) },
        reflector.name, element('small', { textContent: count === 1 ? '1 view' : `${count} views` })),
      element('button', { className: 'icon', innerHTML: pencil, title: 'Rename', ariaLabel: `Rename ${reflector.name}`, onclick: () => rename(reflector) }),
      element('button', { className: 'icon', innerHTML: bin, title: 'Delete', ariaLabel: `Delete ${reflector.name}`, onclick: () => remove(reflector) }));
    row.setAttribute('aria-current', reflector === painting.reflector);
    return row;
  });
  $('reflectors').replaceChildren(...rows);
}

// Questions -----------------------------------------------------------------------------------------------------------

// Ask in a dialog; `work` gets the text and may throw, then its words are shown and the dialog stays.
function ask({ title, text, ok, cancel = 'Cancel', value, work }) {
  const dialog = $('ask');
  const [heading, words, error] = ['h2', 'p', '.error'].map((s) => dialog.querySelector(s));
  const input = dialog.querySelector('input');
  const [no, yes] = dialog.querySelectorAll('button');
  heading.textContent = title;
  words.textContent = text;
  error.textContent = '';
  input.hidden = value === undefined;
  input.value = value ?? '';
  no.textContent = cancel;
  no.onclick = () => dialog.close('');
  yes.textContent = ok;
  return new Promise((resolve) => {
    yes.onclick = async (event) => {
      event.preventDefault();
      try {
        await work?.(input.value.trim());
        dialog.close('ok');
      } catch (problem) {
        error.textContent = problem.remedy ? `${problem.found} ${capital(problem.remedy)}.` : problem.message;
      }
    };
    dialog.onclose = () => {
      stage.canvas.focus();
      resolve(dialog.returnValue === 'ok');
    };
    dialog.returnValue = '';
    dialog.showModal();
    if (value !== undefined) input.select();
  });
}

const newColor = () => COLORS.find((c) => painting.reflectors.every((r) => r.color !== c)) ?? COLORS[0];

function checkName(name) {
  if (!/^[\p{L}\p{N}_]([\p{L}\p{N}_ -]*[\p{L}\p{N}_])?$/u.test(name)) {
    throw new Error('A name has letters, digits, spaces, - and _, and begins and ends with a letter or digit.');
  }
  if (painting.reflectors.some((r) => r.name === name)) throw new Error(`There is a reflector ${name} already.`);
}

function add() {
  return ask({
    title: 'Add a reflector', text: 'Each shiny object has masks and a volume of its own.', ok: 'Add', value: '',
    work: (name) => {
      checkName(name);
      painting.addReflector(name, newColor());
    },
  });
}

function rename(reflector) {
  return ask({
    title: `Rename ${reflector.name}`, text: 'Its masks are kept.', ok: 'Rename', value: reflector.name,
    work: async (name) => {
      if (name === reflector.name) return;
      checkName(name);
      await painting.renameReflector(reflector, name);
    },
  });
}

function remove(reflector) {
  const count = painting.painted(reflector).length;
  return ask({
    title: `Delete ${reflector.name}?`,
    text: count ? `Its ${count === 1 ? 'mask is' : `${count} masks are`} moved to the folder removed_masks in the capture.` : 'It has no masks.',
    ok: 'Delete', work: () => painting.deleteReflector(reflector),
  });
}

const conflicts = [];
async function settleConflicts(conflict) {
  conflicts.push(conflict);
  if (conflicts.length > 1) return;
  while (conflicts.length) {
    const [{ reflector, view }] = conflicts;
    const keep = await ask({
      title: 'This mask changed elsewhere',
      text: `Another tab or program saved the mask of ${reflector.name} in ${painting.views[view].name} after this page had read it. `
        + 'If you take that one, undo brings yours back.',
      ok: 'Keep mine', cancel: 'Take the other',
    });
    painting.resolve(conflicts.shift(), keep);
  }
}

async function outline(by) {
  const { view, reflector } = painting;
  $('busy').hidden = false;
  $('outline').disabled = $('grabcut').disabled = true;
  try {
    const { runs } = await post('outline', { view, by, runs: painting.runs(reflector, view) });
    painting.change(runs, reflector, view);
    showProblem(painting.problem);
  } catch (error) {
    showProblem(error);
  } finally {
    $('busy').hidden = true;
    $('outline').disabled = $('grabcut').disabled = false;
  }
}

function clear() {
  painting.change([painting.size(painting.view)]);
}

// Buttons and events --------------------------------------------------------------------------------------------------

function toggle(box) {
  box.checked = !box.checked;
  box.dispatchEvent(new Event('change'));
}

const nextToPaint = () => filmstrip.next(1, (i) => painting.views[i].proposed && !painting.painted(painting.reflector).includes(i));
const clicks = {
  outline: () => outline('edges'), grabcut: () => outline('color'), clear, add, undo: () => painting.undo(), redo: () => painting.redo(),
  previous: () => painting.chooseView(filmstrip.next(-1)), next: () => painting.chooseView(filmstrip.next(1)),
  'zoom-in': () => stage.zoom(1.25), 'zoom-out': () => stage.zoom(0.8), fit: () => stage.fit(),
  'help-button': () => $('help').showModal(),
};
for (const [id, work] of Object.entries(clicks)) $(id).addEventListener('click', () => work());
for (const button of document.querySelectorAll('button[data-tool]')) {
  button.addEventListener('click', () => stage.setTool(button.dataset.tool));
}
// After a click the keys belong to the picture again; who came by keyboard stays where they are.
for (const part of document.querySelectorAll('.tools, .bar, #filmstrip, #reflectors, #advice')) {
  part.addEventListener('click', (e) => { if (e.detail && e.target.closest('button') && !$('ask').open) stage.canvas.focus(); });
}
$('radius').addEventListener('input', (e) => {
  const { width, height } = painting.views[painting.view];
  stage.setRadius(1 + (e.target.value / 100) ** 2 * (Math.max(width, height) / 4));
});
$('show-mask').addEventListener('change', (e) => { stage.showMask = e.target.checked; stage.draw(); });
$('show-volume').addEventListener('change', (e) => { stage.showVolume = e.target.checked; stage.draw(); });
$('banner').querySelector('button').addEventListener('click', () => {
  showProblem(null);
  painting.flush();
});
$('help').querySelector('.keys').append(...KEYS.map(([words, ...keys]) =>
  element('div', {}, element('span', { textContent: words }),
    element('span', {}, ...keys.flatMap((k) => [element('kbd', { textContent: k }), ' '])))));

stage.addEventListener('begin', () => {
  if (!painting.reflector) painting.addReflector('reflector', newColor());
});
stage.addEventListener('end', showAdvice);
stage.addEventListener('tool', showTools);
stage.addEventListener('zoom', showTools);
stage.addEventListener('problem', (e) => showProblem(e.detail));
const shown = { masks: [showView, showTools, showReflectors, showAdvice], reports: [showAdvice], status: [showStatus] };
shown.reflectors = [showReflectors, showView, showAdvice];
shown.view = [showView, showTools];
for (const [name, functions] of Object.entries(shown)) {
  for (const show of functions) painting.addEventListener(name, show);
}
painting.addEventListener('conflict', (e) => settleConflicts(e.detail));
addEventListener('beforeunload', (e) => { if (painting.unsaved().length) e.preventDefault(); });
addEventListener('focus', () => painting.catchUp());

// Keys ----------------------------------------------------------------------------------------------------------------

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const keys = {
  b: () => stage.setTool('brush'), e: () => stage.setTool('eraser'), p: () => stage.setTool('polygon'), h: () => stage.setTool('hand'),
  g: clicks.outline, a: add, n: () => painting.chooseView(nextToPaint()), m: () => toggle($('show-mask')), v: () => toggle($('show-volume')),
  ',': clicks.previous, PageUp: clicks.previous, '.': clicks.next, PageDown: clicks.next,
  '[': () => stage.setRadius(stage.radius / 1.2), ']': () => stage.setRadius(stage.radius * 1.2),
  '+': () => stage.zoom(1.25), '=': () => stage.zoom(1.25), '-': () => stage.zoom(0.8), 0: () => stage.fit(),
  Delete: clear, Escape: () => stage.cancel(), '?': () => $('help').showModal(),
  Backspace: () => stage.removeCorner(), Enter: () => stage.closePolygon(),
};

addEventListener('keydown', (event) => {
  const { key, target } = event;
  if (document.querySelector('dialog[open]') || target.matches?.('input:not([type=checkbox])')) return;
  const letter = key.length === 1 ? key.toLowerCase() : key;
  let work;
  if (event.ctrlKey || event.metaKey) {
    const corner = stage.corners.length > 0;
    const undo = corner ? () => stage.removeCorner() : () => painting.undo();
    work = { z: event.shiftKey ? () => painting.redo() : undo, y: () => painting.redo(), s: () => painting.flush() }[letter];
  } else if (event.altKey || (target.closest?.('button') && [' ', 'Enter'].includes(key))) {
    return;
  } else if (ARROWS[key]) {
    const step = event.shiftKey ? 24 : 4;
    work = () => stage.moveCursor(...ARROWS[key].map((v) => v * step));
    const frame = target.closest?.('.frame');
    if (frame) work = () => walkFilmstrip(frame, key === 'ArrowLeft' || key === 'ArrowUp' ? -1 : 1);
  } else if (key === ' ') {
    work = () => { if (!event.repeat) stage.penDown(); };
  } else if (/^[1-9]$/.test(key)) {
    const reflector = painting.reflectors[key - 1];
    work = () => { if (reflector) painting.chooseReflector(reflector); };
  } else {
    work = key === 'G' ? clicks.grabcut : keys[letter];
  }
  if (!work) return;
  event.preventDefault();
  work();
});
addEventListener('keyup', (event) => { if (event.key === ' ' && stage.mode !== 'stroke') stage.penUp(); });
addEventListener('blur', () => { if (stage.mode !== 'stroke') stage.penUp(); });

function walkFilmstrip(frame, step) {
  const frames = [...document.querySelectorAll('.frame')];
  frames[(frames.indexOf(frame) + step + frames.length) % frames.length].focus();
}

// Start ---------------------------------------------------------------------------------------------------------------

$('capture').replaceChildren(state.capture, ' ', element('small', { textContent: 'masks' }));
document.title = `${state.capture}: masks`;
const first = painting.views.findIndex((v) => v.proposed);
painting.chooseView(Math.max(first, 0));
stage.setRadius(Math.max(painting.views[0].width, painting.views[0].height) * 0.03);
stage.setTool('brush');
showReflectors();
showAdvice();
try {
  await painting.load(state.reflectors);
  if (painting.restored) console.info(`${painting.restored} masks came from this browser's store`);
} catch (error) {
  if (error.status === undefined) throw error;
  painting.problem = error;
}
showStatus();
stage.canvas.focus();
window.painter = { painting, stage }; // for tests and the curious
document.body.dataset.ready = 'yes';
