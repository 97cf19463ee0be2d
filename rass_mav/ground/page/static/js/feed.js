// News from the server, as long as the page is open.

/** No sign of the server for so long means that it is gone, and so soon it is asked again: milliseconds. */
const SILENCE_MS = 25000;
const AGAIN_MS = 3000;

/**
 * Connect, and connect again whenever the connection ends.
 * @param {Record<string, (data: any) => void>} handlers by the kind of event: mission, news, node, beat
 * @param {(state: "open" | "lost" | "over" | "refused") => void} tell
 */
export function startFeed(handlers, tell) {
  let source = null;
  let timer = 0;
  /** Whether the server said that it stops. */
  let over = false;

  const again = (state, wait) => {
    clearTimeout(timer);
    if (source !== null) source.close();
    source = null;
    tell(state === "lost" && over ? "over" : state);
    timer = setTimeout(connect, wait);
  };
  const heard = () => {
    clearTimeout(timer);
    timer = setTimeout(() => again("lost", AGAIN_MS), SILENCE_MS);
  };
  const failed = async () => {
    clearTimeout(timer);
    source.close();
    source = null;
    let state = "lost";
    try {
      // An event source does not say why it failed.
      const answer = await fetch("/api/at?t=0", { method: "HEAD" });
      if (answer.status === 401) location.assign("/login");
      else state = "refused";
    } catch {
      // The server is gone.
    }
    again(state, AGAIN_MS);
  };
  function connect() {
    source = new EventSource("/api/events");
    source.onerror = failed;
    for (const [kind, handle] of Object.entries(handlers)) {
      source.addEventListener(kind, (event) => {
        heard();
        over = false;
        tell("open");
        handle(JSON.parse(event.data));
      });
    }
    source.addEventListener("end", () => {
      over = true;
    });
  }
  connect();
}
