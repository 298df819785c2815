"""One module per object; each has ``build() -> SceneObject``."""
