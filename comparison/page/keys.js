// Start viewers lazily when they approach the window; direct keys to the current viewer.

const roots = [...document.querySelectorAll(".viewer")], viewers = new Map();

function viewerOf(root) {
  if (!viewers.has(root)) viewers.set(root, new Viewer(root));
  return viewers.get(root);
}

const arrivals = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) if (isIntersecting) viewerOf(target);
}, { rootMargin: "1000px" });
for (const root of roots) arrivals.observe(root);

// The current viewer: full-screen, else focused, else nearest to the middle of the window.
function current() {
  const distance = (root) => {
    const box = root.getBoundingClientRect();
    return Math.abs((box.top + box.bottom) / 2 - window.innerHeight / 2);
  };
  return roots.find((root) => root.classList.contains("full")) || document.activeElement.closest?.(".viewer")
    || roots.toSorted((a, b) => distance(a) - distance(b))[0];
}

// Go to the viewer of the next or previous scene and transfer the view.
function go(by) {
  const here = current(), there = roots[roots.indexOf(here) + by];
  if (!there) return;
  const [from, to] = [viewerOf(here), viewerOf(there)], full = here.classList.contains("full");
  to.adopt(from);
  if (full) {
    here.classList.remove("full");
    to.toggleFull(true);
  } else there.closest("section").scrollIntoView();
  to.stage.focus({ preventScroll: true });
}

const keys = {
  " ": (viewer) => viewer.flip(), s: (viewer) => viewer.setSplit(), k: (viewer) => viewer.nextKind(),
  a: (viewer) => viewer.toggleTiles(), i: (viewer) => viewer.toggleInset(), f: (viewer) => viewer.toggleFull(),
  e: (viewer) => viewer.changeExposure(0.5), E: (viewer) => viewer.changeExposure(-0.5),
  "+": (viewer) => viewer.actions.in(), "-": (viewer) => viewer.actions.out(), 0: (viewer) => viewer.actions.fit(),
  ArrowRight: () => go(1), ArrowLeft: () => go(-1),
};

document.addEventListener("keydown", (event) => {
  if (!roots.length || event.ctrlKey || event.metaKey || event.altKey) return;
  // Buttons handle the space key, form fields handle all keys.
  if (event.target.closest?.("input, select, summary") || (event.key === " " && event.target.closest?.("button, a"))) return;
  const viewer = viewerOf(current()), digit = event.code.match(/^(?:Digit|Numpad)([1-9])$/);
  if (digit) viewer[event.shiftKey ? "showBeside" : "show"](digit[1] - 1);
  else if (keys[event.key] && (event.key !== " " || document.activeElement.closest?.(".viewer"))) keys[event.key](viewer);
  else if (event.key === "Escape" && viewer.root.classList.contains("full")) viewer.toggleFull(false);
  else return;
  event.preventDefault();
});

document.addEventListener("fullscreenchange", () => {
  if (document.fullscreenElement) return;
  for (const viewer of viewers.values()) if (viewer.root.classList.contains("full")) viewer.toggleFull(false);
});
