/* What the mesh of reports and of the studio needs of three. */
export {
  Box3, BufferAttribute, BufferGeometry, Color, DirectionalLight, HemisphereLight, Line,
  LineBasicMaterial, Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Points,
  Raycaster, Scene, ShaderMaterial, Sphere, SphereGeometry, Spherical, TextureLoader, Vector2,
  Vector3, WebGLRenderer,
} from "three";
export {OrbitControls} from "three/examples/jsm/controls/OrbitControls.js";
export {GLTFLoader} from "three/examples/jsm/loaders/GLTFLoader.js";
