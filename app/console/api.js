/** Requests to the service. The only place that calls fetch. */

/** What went wrong: `problem` is the answer's problem document (RFC 9457), null where there was no answer. */
class RequestFailed extends Error {
  constructor(message, problem = null) {
    super(message);
    this.problem = problem;
  }
}

/** Return the JSON of a GET; parameters that are null are left out. Throws `RequestFailed`. */
export function get(path, parameters = {}, signal = undefined) {
  const given = Object.entries(parameters).filter(([, value]) => value !== null);
  return request(given.length ? `${path}?${new URLSearchParams(given)}` : path, { signal });
}

/** Return the JSON of the answer to a POST. Throws `RequestFailed`. */
export function post(path, body) {
  return request(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
}

/** Return the open response of the event stream, resumed after an id. Throws `RequestFailed`. */
export function openStream(lastId, signal) {
  return answer("/v1/airspace/stream", {
    headers: { Accept: "text/event-stream", ...(lastId === null ? {} : { "Last-Event-ID": lastId }) },
    cache: "no-store",
    signal,
  });
}

async function request(path, options) {
  const response = await answer(path, options);
  try {
    return await response.json();
  } catch (error) {
    throw aborted(error) ? error : new RequestFailed("the answer was cut off");
  }
}

async function answer(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch (error) {
    throw aborted(error) ? error : new RequestFailed("the service cannot be reached");
  }
  if (response.ok) return response;
  const problem = await response.json().catch(() => null);
  throw new RequestFailed(problem?.detail ?? `the service answered ${response.status}`, problem);
}

/** Tell whether a request ended because nobody wants its answer any more. */
export const aborted = (error) => error.name === "AbortError";
