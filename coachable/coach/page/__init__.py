"""The live page in a browser: scene, sliders, charts, films."""
