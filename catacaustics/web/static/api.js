// Calls to the server. Paths are relative, so they carry the token of the page's own address.

export class Problem extends Error {
  // status 0: no answer. `found`, `expected`, `remedy` as in the program's own errors.
  constructor(status, body) {
    super(body.found);
    this.status = status;
    Object.assign(this, body);
  }
}

const OFFLINE = {
  found: 'The server does not answer.',
  expected: 'a running `catacaustics mask`',
  remedy: 'start it again and open the address it prints; what you painted is kept in this browser',
};
const OUTDATED = {
  found: 'The server was started again and has a new address.',
  expected: 'the address it printed last',
  remedy: 'open that one; what you painted is kept in this browser',
};

async function call(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch {
    throw new Problem(0, OFFLINE);
  }
  const body = await response.json().catch(() => ({}));
  if (response.ok) return body;
  if (response.status === 403) throw new Problem(403, OUTDATED);
  throw new Problem(response.status, {
    found: `The server refused (${response.status}).`, expected: '', remedy: 'reload the page', ...body,
  });
}

export const get = (path) => call(`api/${path}`);

export const post = (path, body) =>
  call(`api/${path}`, { method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify(body) });

export async function photo(view) {
  const response = await fetch(`api/photo/${view}`).catch(() => { throw new Problem(0, OFFLINE); });
  if (!response.ok) {
    const body = await response.json().catch(() => OUTDATED);
    throw new Problem(response.status, body);
  }
  return createImageBitmap(await response.blob());
}
