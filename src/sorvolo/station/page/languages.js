// What the page says, in the reader's language: English stands in the code, the others in languages/, keyed by the English.

import { choices } from "./choices.js";

/** Languages by their own names. One more is a line here and a file in languages/. */
export const LANGUAGES = { en: "English", de: "Deutsch", es: "Español", fr: "Français", it: "Italiano" };

const wished = navigator.languages ?? [];
const baseOf = (tag) => tag.split("-")[0];
const chosen = choices.get("language");
const language = chosen in LANGUAGES ? chosen : wished.map(baseOf).find((each) => each in LANGUAGES) ?? "en";
const table = language === "en" ? {} : await read();
if (table) document.documentElement.lang = language;

/** For numbers and dates: the reader's own country, where it speaks the language. */
export const locale = language === "en" || !table ? "en-GB" : wished.find((each) => baseOf(each) === language) ?? language;
const plurals = new Intl.PluralRules(locale);

/** A language's texts; null where they cannot be had: English is better than no page. */
async function read() {
  try {
    const answer = await fetch(`/page/languages/${language}.json`, { signal: AbortSignal.timeout(8000) });
    return answer.ok ? await answer.json() : null;
  } catch { return null; }
}

export const numeral = (value, digits = 2) => value.toLocaleString(locale, { maximumFractionDigits: digits, useGrouping: Math.abs(value) >= 10000 });

/** A text of the page. "{name}" is replaced by a value, an element too (then a list is given); "{n} car|{n} cars" is chosen by `n`. */
export function say(english, values = {}) {
  const forms = (table?.[english] ?? english).split("|");
  const text = forms[forms.length > 1 && plurals.select(values.n) !== "one" ? 1 : 0];
  const parts = text.split(/\{(\w+)\}/).map((each, k) => (k % 2 ? shown(values[each]) : each));
  return parts.some((each) => typeof each === "object") ? parts : parts.join("");
}

const shown = (value) => (typeof value === "number" ? numeral(value) : value);
