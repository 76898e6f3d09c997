// A page of photographs: each is in it as pictures that are listed where no script runs.
"use strict";

(() => {
  const listed = [...document.querySelectorAll("article")];
  const rows = [...document.querySelectorAll("tbody tr")];
  const compared = comparison(document.getElementById("comparison"));
  const thumbnails = document.querySelector(".thumbnails"), heading = document.getElementById("chosen");
  const note = document.getElementById("note");
  let chosen = 0;

  function choose(number) {
    chosen = (number + listed.length) % listed.length;
    const article = listed[chosen];
    heading.textContent = article.querySelector("h3").textContent;
    note.textContent = article.querySelector("p")?.textContent ?? "";
    [...thumbnails.children].forEach((button, n) => button.setAttribute("aria-pressed", n === chosen));
    rows.forEach((row, n) => row.classList.toggle("lit", n === chosen));
    compared.show([...article.querySelectorAll("img")].map((image) => ({ label: image.alt, src: image.src })));
  }

  for (const [number, article] of listed.entries()) {
    const pictures = article.querySelectorAll("img");
    thumbnails.append(element("button", { type: "button", onclick: () => choose(number) },
      element("img", { src: pictures[pictures.length - 1].src, alt: "", loading: "lazy" }), article.querySelector("h3").textContent));
    rows[number]?.addEventListener("click", () => choose(number));
  }
  thumbnails.hidden = listed.length < 2;
  document.body.classList.add("scripted");
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "n") choose(chosen + 1);
    else if (event.key === "p") choose(chosen - 1);
    else if (/^[1-9]$/.test(event.key) && event.key <= listed.length) choose(event.key - 1);
  });
  choose(0);
})();
