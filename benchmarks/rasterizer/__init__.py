"""The rasterizer alone: stages and limits (run the package), `renderers`, `constants`, `avx512`, `parts` and
`still_camera`."""
