/* What the report's map needs of Leaflet. */
export {
  CRS, Canvas, Layer, LayerGroup, Map, canvas, circleMarker, featureGroup, imageOverlay,
  latLng, latLngBounds, polygon, polyline, popup, point,
} from "leaflet/dist/leaflet-src.esm.js";
