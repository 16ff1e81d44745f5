// The session, and the view that the address names.

import { element } from './elements.js';
import { Live } from './live.js';
import { agent, fleet } from './fleet.js';
import { conversation, conversations } from './conversations.js';
import { locks } from './locks.js';
import { letters } from './letters.js';
import { past } from './past.js';

const VIEWS = { fleet, agent, conversations, conversation, locks, letters, past };
/** The place in the menu of views that are not in it. */
const PLACES = { agent: 'fleet', conversation: 'conversations' };

const content = document.getElementById('content');
const state = document.getElementById('state');
let live = null;
/** Frees what the shown view holds beside its nodes; null if that is nothing. */
let closeView = null;

/** Exchanges the token for a session, which no script can read. */
async function begin(token) {
  const answer = await fetch('api/session', { method: 'POST', headers: { 'X-Fipa': '1' }, body: token });
  if (!answer.ok) throw new Error((await answer.text()).trim());
}

function say(text, isBad = false) {
  if (state.textContent !== text) state.textContent = text;
  state.classList.toggle('bad', isBad);
}

/** Ends the shown view. */
function leave() {
  live?.close();
  live = null;
  closeView?.();
  closeView = null;
}

function askForToken(problem = '') {
  leave();
  say('not signed in', true);
  const input = element('input', { type: 'password', name: 'token', autocomplete: 'off', required: true });
  const submit = async (event) => {
    event.preventDefault();
    try {
      await begin(input.value);
      show();
    } catch (error) {
      askForToken(error.message);
    }
  };
  content.replaceChildren(
    element('p', {}, 'Run ', element('code', {}, 'fipa dashboard'),
      ' on the robot and open the link that it prints, or enter the token of the gateway.'),
    element('form', { on: { submit } }, element('label', {}, 'Token', input), element('button', {}, 'Sign in')),
    element('p', { class: 'bad-text', role: 'alert' }, problem));
}

/** Shows the view of the address. */
function show() {
  const [, view = 'fleet', parameter, choice] = location.hash.split('/');
  const make = Object.hasOwn(VIEWS, view) ? VIEWS[view] : null;
  if (!make) {
    location.replace('#/fleet');
    return;
  }
  const place = PLACES[view] ?? view;
  for (const item of document.querySelectorAll('nav a')) {
    if (item.getAttribute('href') === `#/${place}`) item.setAttribute('aria-current', 'page');
    else item.removeAttribute('aria-current');
  }
  const name = parameter === undefined ? '' : decodeURIComponent(parameter);
  const { node, path, update, close = null } = make(name, choice === undefined ? null : decodeURIComponent(choice));
  leave();
  closeView = close;
  content.replaceChildren(node);
  document.title = name ? `${name} · fipa` : `fipa · ${view}`;
  say('connecting');
  live = new Live(path, (sections) => {
    const problem = sections.domain?.totals?.problem;
    if (problem) say(problem, true);
    update(sections);
  }, async (isConnected) => {
    if (isConnected) {
      say('live');
      return;
    }
    say('connection lost; trying again', true);
    const answer = await fetch('api/fleet').catch(() => null);
    if (answer?.status === 401) askForToken();
    else if (answer && live?.source.readyState === EventSource.CLOSED) setTimeout(show, 2000);
  });
}

async function start() {
  const token = /^#token=(.+)$/.exec(location.hash)?.[1];
  if (token) {
    // The secret does not stay in the address or in the history.
    history.replaceState(null, '', '#/fleet');
    try {
      await begin(decodeURIComponent(token));
    } catch (error) {
      askForToken(error.message);
      return;
    }
  }
  const answer = await fetch('api/fleet');
  if (answer.status === 401) askForToken();
  else show();
}

addEventListener('hashchange', () => {
  show();
  scrollTo(0, 0);
});
start();
