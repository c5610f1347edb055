/* What the map of a plan's page adds to the kit's: the stations of its lines. */

function extendMap(map, layers, data) {
  const lines = [];
  const groups = [];
  Object.entries(data.lines).forEach(([name, rows]) => {
    const group = layers.get(name);
    groups.push(group);
    group.getLayers().filter((shape) => shape.survey).forEach((shape, i) => {
      const [start, end] = shape.getLatLngs().map(({lat, lng}) => [lat, lng]);
      const [index, first, stations] = rows[i];
      lines.push(stationLine(start, end, {
        group, index, first, stations, colour: shape.options.color, text: shape.survey.text,
      }));
    });
  });
  layers.get("contours")?.eachLayer((shape) => {
    if (shape.survey) shape.bindTooltip(shape.survey.text, {sticky: true});
  });
  return drawStations(map, {
    ...data, groups, lines: () => lines.filter((line) => map.hasLayer(line.group)),
    stations: layers.get("stations"), footprints: layers.get("footprints"),
  }).textAt;
}
