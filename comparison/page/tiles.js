// Pictures of all integrators below the stage, which show the region of the stage or of the inset.

class Tiles {
  constructor(viewer, root) {
    this.viewer = viewer;
    this.inset = null; // [x, y, width, height] in pixels of the picture
    this.are_shown = false;
    this.figures = viewer.views.map((view, index) => {
      const figure = root.appendChild(document.createElement("figure"));
      const canvas = figure.appendChild(document.createElement("canvas"));
      const caption = figure.appendChild(document.createElement("figcaption"));
      const button = caption.appendChild(document.createElement("button"));
      Object.assign(button, { type: "button", textContent: index + 1, title: `show ${view.title}` });
      for (const element of [button, canvas]) element.addEventListener("click", () => viewer.show(index));
      caption.append(` ${view.title}`, Object.assign(document.createElement("span"), { textContent: view.error || "" }));
      caption.appendChild(document.createElement("span")).className = "here";
      if (view.exr) {
        caption.append(Object.assign(document.createElement("a"), { href: encodeURIComponent(view.exr), textContent: "EXR" }));
      }
      return figure;
    });
  }

  get region() {
    return this.inset || this.viewer.region();
  }

  // Redraw the visible pictures.
  async draw() {
    const { viewer, figures } = this, shown = this.are_shown || Boolean(this.inset);
    viewer.find(".tiles").classList.toggle("drawn", shown);
    figures.forEach((figure, index) => {
      figure.classList.toggle("chosen", viewer.visible().includes(index));
      figure.querySelector(".here").textContent = "";
    });
    if (!shown) return;
    const pictures = await Promise.all(figures.map((_, index) => viewer.picture(index)));
    const [x, y, width, height] = this.region;
    figures.forEach((figure, index) => {
      const canvas = figure.querySelector("canvas"), across = canvas.clientWidth * (window.devicePixelRatio || 1);
      canvas.width = Math.round(across);
      canvas.height = Math.max(1, Math.round((across * height) / width));
      const context = canvas.getContext("2d");
      context.imageSmoothingEnabled = canvas.width < width;
      context.drawImage(pictures[index], x, y, width, height, 0, 0, canvas.width, canvas.height);
    });
    viewer.find(".tiles").dataset.drawn = (this.turn = (this.turn || 0) + 1);
    if (this.inset) this.measure();
  }

  // Display the mean relative error inside the inset.
  async measure() {
    const [x, y, width, height] = this.inset;
    for (const [index, view] of this.viewer.views.entries()) {
      if (!view.maps.relative) continue;
      const codes = await this.viewer.codes(view.maps.relative), across = view.maps.relative.width;
      let sum = 0;
      for (let row = y; row < y + height; row++) {
        for (let column = x; column < x + width; column++) sum += maps.relative.number(codes[row * across + column]);
      }
      this.figures[index].querySelector(".here").textContent = `here ${percent(sum / (width * height))}`;
    }
  }
}
