// Tables of three pictures in the gallery become one picture, split by a line that is dragged. Where no scripts run,
// the tables stay.
"use strict";

function comparison(table) {
  const pictures = [...table.querySelectorAll("td img")];
  const titles = [...table.querySelectorAll("th")].map((cell) => cell.textContent.trim());
  const numbers = [...table.querySelectorAll("tbody tr:last-child td")].map((cell) => cell.innerHTML);
  const box = document.createElement("div");
  box.className = "compared";
  box.innerHTML = `<div class="stage"><img><img class="over"><input type="range" min="0" max="100" step="any"
    value="50"></div><div class="names"><span></span><span></span></div><div class="choice"></div>`;
  const [below, over] = box.querySelectorAll("img");
  const [left, right] = box.querySelectorAll(".names span");
  const stage = box.querySelector(".stage"), slider = box.querySelector("input"), choice = box.querySelector(".choice");

  const move = () => stage.style.setProperty("--at", `${slider.value}%`);
  slider.addEventListener("input", move);

  function show(a, b, button) {
    [over.src, over.alt, below.src, below.alt] = [pictures[a].src, pictures[a].alt, pictures[b].src, pictures[b].alt];
    left.innerHTML = `<strong>${titles[a]}</strong><br>${numbers[a]}`;
    right.innerHTML = `<strong>${titles[b]}</strong><br>${numbers[b]}`;
    slider.setAttribute("aria-label", `Line between ${titles[a]} and ${titles[b]}`);
    for (const other of choice.children) other.setAttribute("aria-pressed", other === button);
  }

  for (const [a, b] of [[0, 1], [0, 2], [1, 2]]) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `${titles[a]} | ${titles[b]}`;
    button.addEventListener("click", () => show(a, b, button));
    choice.append(button);
  }
  show(0, 1, choice.firstElementChild);
  move();
  return box;
}

document.addEventListener("DOMContentLoaded", () => {
  for (const table of document.querySelectorAll("table")) {
    if (table.querySelectorAll("td img").length !== 3) continue;
    (table.closest(".table-wrapper") ?? table).replaceWith(comparison(table));
  }
});
