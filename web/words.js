// What the daemon says, in another language. It says it in English; a catalogue has its sentences, `{}` for what is put
// in, and how each reads here. What no sentence of it fits is left as it is: nothing that was said is lost.
const SEPARATORS = ["; ", ", ", ": "];
const KEPT_N = 500;
/** So many parts of a list may be one sentence of the catalogue, with what is put into it. */
const RUN_N = 6;
/** What is longer says nothing that a daemon says. */
const LONGEST_N = 1500;

export class Words {
  constructor(catalogue) {
    this.whole = new Map();
    this.patterns = [];
    for (const [english, here] of Object.entries(catalogue)) {
      const parts = english.split("{}");
      if (parts.length === 1) this.whole.set(english, here);
      else this.patterns.push({ parts, here, weight: parts.join("").length });
    }
    // Of two that fit, the one that says more itself.
    this.patterns.sort((a, b) => b.weight - a.weight);
    this.said = new Map();
  }

  /** `text` as it reads here, as far as it is known. */
  in(text) {
    if (!this.said.has(text)) {
      if (this.said.size >= KEPT_N) this.said.clear();
      this.said.set(text, text.length > LONGEST_N ? text : (this.known(text) ?? this.pieces(text)));
    }
    return this.said.get(text);
  }

  known(text) {
    if (this.whole.has(text)) return this.whole.get(text);
    const colon = text.indexOf(": "), head = colon < 0 ? null : this.known(text.slice(0, colon));
    const rest = head === null ? null : this.known(text.slice(colon + 2));
    if (rest !== null) return `${head}: ${rest}`;
    for (const { parts, here } of this.patterns) {
      const put_in = fillings(text, parts);
      // In quotes or brackets stands a name that somebody gave, or a section of the configuration.
      if (put_in) return here.replace(/(['[]?)\{(\d)\}/g, (_, mark, n) => mark + (mark ? put_in[n] : this.in(put_in[n])));
    }
    return null;
  }

  /** Of a list, each of its sentences: the longest first, since a sentence may have the list's separator in itself. */
  pieces(text) {
    const separator = SEPARATORS.find((one) => text.includes(one));
    if (!separator) return text;
    const parts = text.split(separator), found = [];
    for (let first = 0, last; first < parts.length; first = last) {
      let here = null;
      for (last = Math.min(parts.length, first + RUN_N); here === null && last > first; last--) {
        const run = parts.slice(first, last).join(separator);
        here = run === text ? null : this.known(run);
      }
      last++;
      found.push(here ?? this.pieces(parts[first]));
    }
    return found.join(separator);
  }
}

/** What stands in `text` where `parts` leave room, or null where they do not fit. No way back is taken: it ends at once
 * whatever a stranger writes. */
function fillings(text, parts) {
  const end = parts.at(-1), found = [];
  if (!text.startsWith(parts[0]) || !text.endsWith(end)) return null;
  let at = parts[0].length;
  for (const part of parts.slice(1, -1)) {
    const next = text.indexOf(part, at + 1);
    if (next < 0) return null;
    found.push(text.slice(at, next));
    at = next + part.length;
  }
  if (text.length - end.length <= at) return null;
  found.push(text.slice(at, text.length - end.length));
  return found;
}
