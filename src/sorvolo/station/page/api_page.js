// The API as a page to read: each address of /openapi.json with what it does, takes and gives.

import { get } from "./api.js";
import { el, fill } from "./dom.js";
import { say } from "./languages.js";
import { grouped } from "./site_data.js";

/** List the station's addresses for who writes a program of their own. */
export async function showApi(main, title) {
  const { paths, components } = await get("/openapi.json");
  fill(title, el("h1", "API"));
  document.title = `API – ${say("Sorvolo station")}`;
  const all = Object.entries(paths).flatMap(([path, methods]) => Object.entries(methods).map(([method, asked]) => ({ path, method, asked })));
  fill(main, el("div.sites.api",
    el("p", say("What a program may ask of this station. The same for tools, as OpenAPI: {link}. Where the station has tokens, send one as {header}.", { link: el("a", { href: "/openapi.json" }, "openapi.json"), header: "Authorization: Bearer TOKEN" }), " ", el("a", { href: "#/" }, say("All sites"))),
    [...grouped(all, ({ asked }) => asked.tags?.[0] ?? "station")].map(([name, list]) => [el("h2", name),
      list.map(({ path, method, asked }) => address(method.toUpperCase(), path, asked, components?.schemas ?? {}))])));
  return { close() {} };
}

function address(method, path, asked, schemas) {
  const body = Object.entries(asked.requestBody?.content ?? {});
  const plain = method === "GET" && !(asked.parameters ?? []).some((each) => each.required);
  return el("details",
    el("summary", el("code", `${method} ${path}`)),
    el("p", asked.description ?? asked.summary, plain ? [" ", el("a", { href: path }, say("Ask it"))] : null),
    rows((asked.parameters ?? []).map((each) => [each.name, `${each.in}${each.required ? `, ${say("needed")}` : ""}`, typeOf(each.schema, schemas), each.description])),
    body.map(([kind, { schema }]) => [el("p", say("Body: {kind}", { kind: el("code", kind) })), rows(fieldsOf(schema, schemas))]),
    el("p.soft", say("Answers {codes}", { codes: Object.keys(asked.responses).join(", ") })));
}

function fieldsOf(schema, schemas) {
  const { properties = {}, required = [] } = resolved(schema, schemas);
  return Object.entries(properties).map(([name, each]) => [name, required.includes(name) ? say("needed") : "", typeOf(each, schemas), each.description]);
}

function rows(lines) {
  if (!lines.length) return null;
  return el("table", lines.map(([name, ...rest]) => el("tr", el("th", { scope: "row" }, name), rest.map((each) => el("td", each ?? "")))));
}

function resolved(schema = {}, schemas) {
  return schema.$ref ? schemas[schema.$ref.split("/").at(-1)] ?? {} : schema;
}

/** A value's type in words: "integer 1 to 1000", "text", "confirmed | rejected", "{upload, stream}". */
function typeOf(schema, schemas) {
  const { type, enum: choices, anyOf, items, minimum, maximum, properties } = resolved(schema, schemas);
  if (properties) return `{${Object.keys(properties).join(", ")}}`;
  if (choices) return choices.join(" | ");
  if (anyOf) return anyOf.filter((each) => each.type !== "null").map((each) => typeOf(each, schemas)).join(" or ");
  if (type === "array") return `list of ${typeOf(items, schemas)}`;
  const range = minimum !== undefined && maximum !== undefined ? ` ${minimum} to ${maximum}` : "";
  return `${type === "string" ? "text" : type ?? "any"}${range}`;
}
