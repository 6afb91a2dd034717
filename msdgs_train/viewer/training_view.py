"""A run looked at while it trains: the viewer with the run's state, a pause, and a bound on what looking costs."""

from msdgs_train.engine.observer import Observer
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.evaluation.metrics import ImageMetrics
from msdgs_train.viewer.snapshot import snapshot_of_training
from msdgs_train.viewer.stage import view_of_data
from msdgs_train.viewer.viewer import Viewer

SHARE = 0.25  # of the time, for drawing, unless somebody moves the slider
STATUS_SECONDS = 0.5  # of training, between texts


class TrainingView(Observer):
    """Hands a viewer copies of the model between steps, only when somebody looks; the model itself is never drawn."""

    def __init__(self, viewer: Viewer, steps: int) -> None:
        self._viewer = viewer
        self._steps = steps
        self._trainer: Trainer | None = None
        self._told: tuple[int, float] | None = None  # step and seconds of the text that is shown
        self._judged = ""
        viewer.set_status("reading images, compiling kernels")

    def on_train_start(self, trainer: Trainer) -> None:
        is_first, self._trainer, self._told = self._trainer is None, trainer, None
        if not is_first:
            return
        gui = self._viewer.server.gui
        self._folder = gui.add_folder("training")
        with self._folder:
            self._paused = gui.add_checkbox("pause", False)
            hint = "of the time that drawing may take away from training"
            self._share = gui.add_slider("share", 0.05, 0.9, 0.05, SHARE, hint=hint)
        self._viewer.open(view_of_data(trainer.scene, len(trainer.config.model.layers)))
        self._hand_over()

    def step(self, result: StepResult, seconds: float) -> None:
        if self._viewer.is_waiting:
            self._hand_over()
        self._viewer.share = self._share.value
        if self._told is None:
            self._told = result.step, seconds
        step, before = self._told
        if seconds - before < STATUS_SECONDS and result.step < self._steps:
            return
        self._told = result.step, seconds
        speed = (result.step - step) / max(seconds - before, 1e-9)
        self._viewer.set_status(
            f"**step {result.step:,}** of {self._steps:,}, {speed:.1f} steps/s  \n"
            f"{result.gaussians:,} Gaussians  \ntrain PSNR {result.psnr:.2f} dB{self._judged}"
        )

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        self._judged = f"  \n{split} PSNR {metrics.psnr:.2f} dB at step {step:,}"

    def is_paused(self) -> bool:
        paused = bool(self._paused.value)
        self._viewer.share = 1.0 if paused else self._share.value
        if paused and self._viewer.is_waiting:
            self._hand_over()
        return paused

    def wait_for_interrupt(self) -> None:
        """Show what came out of the run until Ctrl-C, which is raised."""
        self._folder.visible = False
        self._viewer.share = 1.0
        self._hand_over()
        self._viewer.wait_for_interrupt()

    def _hand_over(self) -> None:
        if self._trainer is not None:
            self._viewer.show(snapshot_of_training(self._trainer))
