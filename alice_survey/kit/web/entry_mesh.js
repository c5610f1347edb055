/* What the report's mesh needs of three. */
export {
  Box3, Color, DirectionalLight, HemisphereLight, MeshLambertMaterial, PerspectiveCamera, Scene,
  Sphere, Spherical, TextureLoader, Vector3, WebGLRenderer,
} from "three";
export {OrbitControls} from "three/examples/jsm/controls/OrbitControls.js";
export {GLTFLoader} from "three/examples/jsm/loaders/GLTFLoader.js";
