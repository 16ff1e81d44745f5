// What an agent offers: its services, and its topics with their newest values.

import { clock, element, rate, table } from './elements.js';

const SERVICES = [{ title: 'Service' }, { title: 'Properties' }, { title: 'Protocols, ontologies, languages' }];
const TOPICS = [
  { title: 'Topic' }, { title: 'Rate', class: 'number' }, { title: 'Bytes', class: 'number optional' },
  { title: 'Subscribers', class: 'number optional' }, { title: 'Newest value' },
];

/** The terms of an agent or a service, each list with its name. */
function terms({ protocols, ontologies, languages }) {
  return [['protocols', protocols], ['ontologies', ontologies], ['languages', languages]]
    .filter(([, list]) => list.length > 0).map(([title, list]) => `${title}: ${list.join(', ')}`);
}

function serviceRow(row) {
  const properties = Object.entries(row.properties).map(([name, value]) => element('div', {}, `${name} = ${value}`));
  return element('tr', {},
    element('td', { class: 'name' }, row.type ?? row.name ?? '–',
      row.name && row.name !== row.type ? element('div', { class: 'faint' }, row.name) : null,
      row.ownership ? element('div', { class: 'faint' }, `of ${row.ownership}`) : null),
    element('td', {}, properties),
    element('td', {}, terms(row).map((text) => element('div', {}, text))));
}

function hertz(row) {
  const declared = row.rate === null ? '' : `${rate(row.rate)} declared`;
  if (row.measured_rate === null) return [declared];
  return [`${rate(row.measured_rate)}/s`, declared ? element('div', { class: 'faint' }, declared) : null];
}

/** The newest value of a topic as text. An image has its picture below the table. */
function newest(row, agent) {
  if (!row.followed) {
    return ['not followed: a page follows four topics. ',
      element('a', { href: `#/agent/${encodeURIComponent(agent)}/${encodeURIComponent(row.name)}` }, `Follow ${row.name}`)];
  }
  if (!row.value) return [row.problem ? element('span', { class: 'bad-text' }, row.problem) : 'none yet'];
  const { text, cut, image, bytes, time, language } = row.value;
  const facts = [clock(time), language, row.problem].filter(Boolean).join(' · ');
  let shown = element('div', {}, `${bytes} bytes that are no text and no known image`);
  if (image) shown = element('div', {}, `image of ${image.width} × ${image.height} pixels, below`);
  else if (text !== null) shown = element('code', { class: 'value' }, cut ? `${text}…` : text);
  return [shown, element('div', { class: 'faint' }, facts)];
}

/** The pictures of the topics with images. Each keeps its node, and loads one image after the other. */
class Images {
  constructor(agent) {
    this.agent = agent;
    this.node = element('div', { class: 'images' });
    this.shown = new Map();
  }

  show(topics) {
    const images = Object.entries(topics).filter(([, row]) => row.value?.image);
    for (const [name, row] of images) {
      if (!this.shown.has(name)) this.add(name);
      this.shown.get(name).update(row.value);
    }
    for (const [name, { node }] of this.shown) {
      if (!images.some(([other]) => other === name)) {
        node.remove();
        this.shown.delete(name);
      }
    }
  }

  add(name) {
    const picture = element('img', { class: 'newest', alt: '' });
    const caption = element('figcaption', {});
    const node = element('figure', { class: 'card' }, caption, picture);
    let number = 0;
    const update = (value) => {
      if (value.number === number || (picture.src && !picture.complete)) return;
      number = value.number;
      const parameters = new URLSearchParams({ name: this.agent, topic: name, number });
      const text = `${name}, ${value.image.width} × ${value.image.height} pixels, ${clock(value.time)}`;
      picture.alt = `Newest image of ${text}`;
      picture.width = value.image.width;
      picture.height = value.image.height;
      picture.src = `api/image?${parameters}`;
      caption.textContent = text;
    };
    this.shown.set(name, { node, update });
    this.node.append(node);
  }
}

/** The offer of an agent, with the topic that the address names among those that are followed. */
export function offers(agent) {
  const about = element('p', { class: 'faint' });
  const services = table('Services in the directory facilitator', SERVICES, serviceRow);
  const topics = table('Topics, asked every two seconds', TOPICS, (row) => element('tr', {},
    element('td', { class: 'name' }, row.name, row.media_type ? element('div', { class: 'faint' }, row.media_type) : null),
    element('td', { class: 'number' }, hertz(row)),
    element('td', { class: 'number optional' }, row.bytes === null ? '' : String(row.bytes)),
    element('td', { class: 'number optional' }, String(row.subscribers)),
    element('td', {}, newest(row, agent))));
  const topicBox = element('div', { class: 'card', hidden: true }, topics.node);
  const images = new Images(agent);
  const serviceBox = element('div', { class: 'card' }, services.node, about);
  const node = element('section', { 'aria-label': 'Offers' }, element('h3', {}, 'Offers'), serviceBox, topicBox, images.node);
  const update = (sections) => {
    const offer = sections.offer?.[agent];
    const all = sections.topics ?? {};
    // The topics have a table of their own.
    const listed = Object.entries(sections.services ?? {}).filter(([, row]) => row.type !== 'topic' || !all[row.name]);
    services.rows.show(listed.sort(([a], [b]) => a - b));
    services.node.hidden = listed.length === 0;
    let text = 'asking the directory facilitator';
    if (offer?.problem) text = offer.problem;
    else if (offer?.listed) text = terms(offer).join(' · ');
    else if (offer) text = 'nothing in the directory facilitator';
    if (about.textContent !== text) about.textContent = text;
    about.hidden = text === '';
    about.className = offer?.problem ? 'bad-text' : 'faint';
    serviceBox.hidden = services.node.hidden && about.hidden;
    topics.rows.show(Object.entries(all).sort(([a], [b]) => (a < b ? -1 : 1)));
    topicBox.hidden = Object.keys(all).length === 0;
    images.show(all);
  };
  return { node, update };
}
