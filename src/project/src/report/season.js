(() => {
  const data = JSON.parse(document.getElementById('season-data').textContent);
  const slider = document.getElementById('season-date');
  const choice = document.getElementById('season-trait');
  const label = document.getElementById('season-label');
  const ramp = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const colour = (share) => {
    const at = Math.min(Math.max(share, 0), 1) * (ramp.length - 1);
    const k = Math.min(Math.floor(at), ramp.length - 2);
    const mix = ramp[k].map((low, i) => Math.round(low + (at - k) * (ramp[k + 1][i] - low)));
    return `rgb(${mix.join(',')})`;
  };
  const show = () => {
    const k = Number(slider.value);
    const trait = data.traits[Number(choice.value)];
    label.textContent = `${data.dates[k]}: ${trait.name} from ${trait.low} (dark) to ${trait.high} (light)`;
    document.querySelectorAll('#season-map path').forEach((shape, plot) => {
      const value = trait.values[plot][k];
      const share = (value - trait.low) / ((trait.high - trait.low) || 1);
      shape.setAttribute('fill', value === null ? 'none' : colour(share));
      shape.querySelector('title').textContent =
        `${data.plots[plot]}: ${value === null ? 'no value' : value}`;
    });
  };
  slider.addEventListener('input', show);
  choice.addEventListener('change', show);
  show();
})();
