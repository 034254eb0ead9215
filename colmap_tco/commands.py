"""The subcommands of ``colmap-tco``: what each is called, what it takes, and where its work is."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Protocol


class Argument(NamedTuple):
    """A word of a command line that belongs to no flag.

    Attributes:
        name: for the usage line.
        help: what it is.
        kind: what it becomes, ``Path`` or ``str``.
        choices: the words allowed, or None.
        optional: whether it may be missing; it is None then.
    """

    name: str
    help: str
    kind: type = Path
    choices: tuple[str, ...] | None = None
    optional: bool = False

    @property
    def shown(self) -> str:
        """The name as the usage line has it."""
        return f"[{self.name.upper()}]" if self.optional else self.name.upper()


WORKSPACE = Argument("workspace", "folder with images/ and, unless it is to be made, a COLMAP model")
DENSE = Argument("workspace", "folder with dense-tco/, or any dense workspace of COLMAP")


class Command(NamedTuple):
    """A subcommand, with everything but its help text imported only when it is called.

    Attributes:
        help: one line for the list of commands.
        config: ``module:Dataclass``, which the flags are generated from. The module must not import
            torch, numpy or pycolmap at its top, so that ``--help`` stays fast.
        function: ``module:function``, called as ``function(*arguments, config, progress)``. It returns a
            :class:`Summary` or None.
        arguments: the words that belong to no flag, in order.
        common: the flags that ``--help`` lists, without dashes and with blanks between them, and
            ``--help_all`` the others too; empty: there are no others.
    """

    help: str
    config: str
    function: str
    arguments: tuple[Argument, ...] = (WORKSPACE,)
    common: str = ""


class Summary(Protocol):
    """What a command returns to be shown to the user."""

    def summary(self) -> str:
        """The closing message: where the results are and how good they are."""
        ...


COMMANDS: dict[str, Command] = {
    "densify": Command(
        "make depth maps and a fused cloud of a COLMAP workspace",
        "colmap_tco.densify:DensifyConfig",
        "colmap_tco.densify:densify",
        common="overwrite refine_cameras backbone weights device steps max_image_size mask_path "
        "min_num_pixels cache_size num_threads min_confidence max_depth_ratio roi voxel_size max_points "
        "fill_only image_path model_path matcher cameras",
    ),
    "poses": Command(
        "find poses of images from their depth maps (RGB-D, LiDAR): a COLMAP model and a trajectory",
        "colmap_tco.poses:PosesConfig",
        "colmap_tco.poses:poses",
        (Argument("images", "folder of the images"),),
        "depths depth_unit output_path overwrite steps rough match camera_model camera_params rough_scale "
        "free_scale backbone weights device",
    ),
    "report": Command(
        "make the page of a finished result anew and open it in the browser",
        "colmap_tco.show:ReportConfig",
        "colmap_tco.show:show_report",
    ),
    "view": Command(
        "look at the cameras and clouds of a finished result in an interactive viewer (needs the extra view)",
        "colmap_tco.viewer:ViewerConfig",
        "colmap_tco.viewer:view",
    ),
    "check": Command(
        "show what this machine has, what each network would need, and which one would run",
        "colmap_tco.check:CheckConfig",
        "colmap_tco.check:check",
    ),
    "weights": Command(
        "list, fetch, find and verify the weights of published networks",
        "colmap_tco.weights:WeightsConfig",
        "colmap_tco.weights:weights",
        (
            Argument("action", "what to do", str, ("list", "fetch", "path", "verify")),
            Argument("network", "whose weights, as the list names it", str, optional=True),
        ),
    ),
    "export": Command(
        "write a finished result for trainers of Gaussian splats, OpenMVS, surveyors (LAS, LAZ) or as text",
        "colmap_tco.export.command:ExportConfig",
        "colmap_tco.export.command:export",
        (Argument("format", "what to write", str, ("3dgs", "openmvs", "las", "text")), DENSE),
    ),
    "mesh": Command(
        "make a coloured mesh of a finished result",
        "colmap_tco.mesh:MeshConfig",
        "colmap_tco.mesh:mesh",
        (DENSE,),
    ),
    "bench": Command(
        "run rows of the paper's tables over ETH3D, DTU, 7-Scenes, NRGBD or ScanNet",
        "colmap_tco.bench.command:BenchConfig",
        "colmap_tco.bench.command:bench",
        (),
        "dataset root setting scenes rows priors output image_width published_settings as_published seed "
        "overwrite backbone weights device steps",
    ),
    "evaluate": Command(
        "compare a result with true depths, a true cloud or true cameras",
        "colmap_tco.evaluation.command:EvaluateConfig",
        "colmap_tco.evaluation.command:evaluate",
        (
            Argument(
                "result", "workspace with dense-tco/, dense workspace of COLMAP, COLMAP model, or a cloud"
            ),
        ),
    ),
}
