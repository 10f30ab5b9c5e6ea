// Sliders for the scene's parameters. One picture is asked for at a time; while it is made, only the newest wish waits.
const picture = document.querySelector('#picture'), status = document.querySelector('#status');
const shown = document.querySelector('#shown'), sliders = document.querySelector('#sliders');
let inputs = [], busy = false, wanted = false;

function say(text, bad = false) { status.textContent = text; status.classList.toggle('bad', bad); }

async function draw() {
  if (busy) { wanted = true; return; }
  busy = true;
  const body = JSON.stringify({ values: inputs.map(input => +input.value), shown: shown.value });
  const waiting = setTimeout(() => say('Rendering …'), 600);
  try {
    const answer = await fetch('api/render', { method: 'POST', headers: { 'content-type': 'application/json' }, body });
    clearTimeout(waiting);
    if (answer.ok) {
      const result = await answer.json();
      picture.src = result.picture;
      say(`${shown.value}: buffers ${result.buffers_ms} ms, model ${result.model_ms} ms`);
    } else if (answer.status === 422) {
      const error = await answer.json();
      say(`${error.found}\n${error.remedy}`, true);
    } else say(await answer.text(), true);
  } catch {
    clearTimeout(waiting);
    say('The server does not answer. Is the command still running?', true);
  }
  busy = false;
  if (wanted) { wanted = false; draw(); }
}

function slider(parameter) {
  const label = document.createElement('label'), input = document.createElement('input'), value = document.createElement('output');
  Object.assign(input, { type: 'range', min: parameter.low, max: parameter.high, step: (parameter.high - parameter.low) / 200 });
  input.value = (parameter.low + parameter.high) / 2;
  const write = () => { value.textContent = (+input.value).toPrecision(3); };
  input.addEventListener('input', () => { write(); draw(); });
  input.addEventListener('change', write);
  write();
  label.append(parameter.name.replaceAll('.', ' '), value, input);
  sliders.append(label);
  return input;
}

function set(share) {
  for (const input of inputs) {
    input.value = +input.min + share() * (input.max - input.min);
    input.dispatchEvent(new Event('change'));
  }
  draw();
}

const state = await (await fetch('api/state')).json();
document.querySelector('#title').textContent = document.title = `${state.scene}: ${state.model}`;
shown.append(...state.shown.map(name => new Option(name)));
shown.addEventListener('change', draw);
inputs = state.parameters.map(slider);
document.querySelector('#middle').addEventListener('click', () => set(() => 0.5));
document.querySelector('#random').addEventListener('click', () => set(Math.random));
draw();
