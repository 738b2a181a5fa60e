// An episode's page: the film, the films of others and all charts show the same tick.
const follow = (course, films) => {
  const data = JSON.parse(document.getElementById("course-data").textContent);
  const charts = [...course.querySelectorAll(".course-chart")].map((box) => ({
    box, cursor: box.querySelector(".cursor"), output: box.querySelector("output"),
    values: JSON.parse(box.dataset.values),
  }));
  const others = [...course.querySelectorAll(".other .screen")].map((screen) => {
    const slider = document.createElement("input"); slider.type = "range"; slider.max = screen.dataset.frames; slider.value = 0;
    return films(screen, document.createElement("button"), slider);
  });
  const tick = document.getElementById("tick");
  const heard = (frame) => {
    tick.textContent = `tick ${frame}, ${(frame * data.tick_s).toFixed(1)} s${frame > data.steps ? ", after its last action" : ""}`;
    for (const chart of charts) {
      chart.cursor.setAttribute("x1", frame); chart.cursor.setAttribute("x2", frame);
      chart.output.textContent = chart.values.map((line) => line[frame]).filter(Boolean).join(", ");
    }
    for (const other of others) other.show(frame);
  };
  const own = course.querySelector("figure.film");
  const player = films(own.querySelector(".screen"), own.querySelector(".controls button"), own.querySelector("input"), heard);
  for (const chart of charts) {
    const seek = (event) => {
      const box = chart.box.querySelector("svg").getBoundingClientRect();
      player.show(Math.round((event.clientX - box.left) / box.width * (data.ticks - 1)));
    };
    chart.box.addEventListener("pointerdown", seek);
    chart.box.addEventListener("pointermove", (event) => { if (event.buttons) seek(event); });
  }
  for (const go of document.querySelectorAll("[data-tick]")) go.addEventListener("click", () => player.show(Number(go.dataset.tick)));
};
