// Dragging with any pointer.

// While a pointer is held down on an element, call `move` with its current and previous position; finally call `end`.
function drag(element, move, end = () => {}) {
  element.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || (event.target !== element && event.target.tagName !== "CANVAS")) return;
    element.setPointerCapture(event.pointerId);
    const from = { x: event.clientX, y: event.clientY };
    let { x, y } = from;
    const step = (next) => {
      move({ dx: next.clientX - x, dy: next.clientY - y, x: next.clientX, y: next.clientY, from });
      [x, y] = [next.clientX, next.clientY];
    };
    element.addEventListener("pointermove", step);
    for (const name of ["pointerup", "pointercancel"]) {
      element.addEventListener(name, () => (element.removeEventListener("pointermove", step), end()), { once: true });
    }
  });
}
