at("save").onclick = () => rootsoptSave(at("yaml").textContent, "config.yaml");
rootsoptCharts().then(documents => {
  if (!data.animation) return;
  const { rotors, cases } = data.animation;
  const timeline = documents.find(one => one.get_model_by_name("cursor"));
  const cursor = timeline && timeline.get_model_by_name("cursor");
  const pair = rootsoptPair(time => { if (cursor) cursor.location = time; });
  const choose = number => pair.show(rotors[cases[number].rotor], cases[number], true);
  if (timeline) timeline.roots()[0].on_event("tap", event => pair.seek(event.x));
  const first = cases.length - 1 && cases[1].name === "optimised" ? 1 : 0;
  choose(first);
  if (at("case")) {
    at("case").value = String(first);
    at("case").onchange = event => choose(Number(event.target.value));
  }
});
