// Elements. What drones say gets into the page here only, and as text.

/**
 * The element with an id.
 * @param {string} id
 * @returns {any}
 */
export function by(id) {
  return document.getElementById(id);
}

/**
 * A new element.
 * @param {string} tag
 * @param {Record<string, string>} [attributes]
 * @param {(Node | string)[]} content nodes, and strings as text
 * @returns {HTMLElement}
 */
export function make(tag, attributes = {}, ...content) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...content);
  return element;
}

/**
 * Set a text, if it is another.
 * @param {Node} element
 * @param {string} text
 */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/**
 * Fill a list of terms; the elements stay, so that a reader does not lose its place.
 * @param {HTMLElement} list a dl
 * @param {[string, string][]} facts
 */
export function tell(list, facts) {
  while (list.children.length > 2 * facts.length) list.lastElementChild.remove();
  facts.forEach(([term, text], index) => {
    if (!list.children[2 * index]) list.append(make("dt"), make("dd"));
    say(list.children[2 * index], term);
    say(list.children[2 * index + 1], text);
  });
}
