"""The viewer during training: with the state of the run, a pause button, and a limit on the time that drawing takes."""

from msdgs_train.engine.observer import Observer
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.evaluation.metrics import ImageMetrics
from msdgs_train.viewer.scene_view import view_of_data
from msdgs_train.viewer.snapshot import snapshot_of_training
from msdgs_train.viewer.viewer import Viewer

TIME_FRACTION = 0.25  # fraction of the time for drawing; initial value of the slider
STATUS_SECONDS = 0.5  # training time between updates of the status


class TrainingView(Observer):
    """Gives a viewer copies of the model between steps, if a browser is connected; the model itself is never drawn."""

    def __init__(self, viewer: Viewer, steps: int) -> None:
        self._viewer = viewer
        self._steps = steps
        self._trainer: Trainer | None = None
        self._shown: tuple[int, float] | None = None  # step and seconds of the current status
        self._metrics = ""
        viewer.set_status("reading images, compiling kernels")

    def on_train_start(self, trainer: Trainer) -> None:
        self._trainer = trainer
        gui = self._viewer.server.gui
        self._folder = gui.add_folder("training")
        with self._folder:
            self._paused = gui.add_checkbox("pause", False)
            hint = "fraction of the time that drawing may take from training"
            self._time_fraction = gui.add_slider("drawing time", 0.05, 0.9, 0.05, TIME_FRACTION, hint=hint)
        self._viewer.open(view_of_data(trainer.scene, len(trainer.config.model.layers)))
        self._hand_over()

    def step(self, result: StepResult, seconds: float) -> None:
        if self._viewer.is_waiting:
            self._hand_over()
        self._viewer.time_fraction = self._time_fraction.value
        if self._shown is None:
            self._shown = result.step, seconds
        step, before = self._shown
        if seconds - before < STATUS_SECONDS and result.step < self._steps:
            return
        self._shown = result.step, seconds
        speed = (result.step - step) / max(seconds - before, 1e-9)
        self._viewer.set_status(
            f"**step {result.step:,}** of {self._steps:,}, {speed:.1f} steps/s  \n"
            f"{result.gaussians:,} Gaussians  \ntrain PSNR {result.psnr:.2f} dB{self._metrics}"
        )

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        self._metrics = f"  \n{split} PSNR {metrics.psnr:.2f} dB at step {step:,}"

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        self._shown = None

    def is_paused(self) -> bool:
        paused = bool(self._paused.value)
        self._viewer.time_fraction = 1.0 if paused else self._time_fraction.value
        if paused and self._viewer.is_waiting:
            self._hand_over()
        return paused

    def wait_for_interrupt(self) -> None:
        """Show the last model until Ctrl-C, which is raised."""
        self._folder.visible = False
        self._viewer.time_fraction = 1.0
        self._hand_over()
        self._viewer.wait_for_interrupt()

    def _hand_over(self) -> None:
        if self._trainer is not None:
            self._viewer.show(snapshot_of_training(self._trainer))
