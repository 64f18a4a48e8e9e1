"""The stages of a run: what each is made of, its settings, and when it may be made again."""

from dataclasses import dataclass
from typing import Literal

from sagesplat.core import config


@dataclass(frozen=True)
class StageKind:
    """What is known of a stage before any run: its files and their hashes are in the record of each run.

    A result that was made with other settings or from other inputs is never replaced without --force, but
    for `again`: "inputs" of a stage that takes minutes is made again for new inputs, as long as its own
    settings are the same; "always" is made again whatever changed, as its settings are the plan's.
    """

    needs: tuple[str, ...] = ()  # stages whose results it is made of, where the run has them
    settings: type | None = None  # how its settings are read; those of other stages are only compared
    of_all_ladders: bool = False  # all ladders of a run share the result
    again: Literal["forced", "inputs", "always"] = "forced"
    command: str = ""  # that does it, where that is not called as the stage


# In the order in which a run does them. Blocks of a large scene are runs of their own, with `interior` and
# `boundaries`; a study appends a number to the stages that it does several times, as in pruned-0.5.
STAGES = {
    "adopt": StageKind(of_all_ladders=True),
    "poses": StageKind((), config.PosesConfig, of_all_ladders=True, command="masks"),
    "scene": StageKind(("adopt", "poses"), config.SceneConfig, of_all_ladders=True, command="masks"),
    "given": StageKind(("scene",), of_all_ladders=True, command="masks"),
    "segment": StageKind(("given", "scene"), of_all_ladders=True, command="masks"),
    "masks": StageKind(("segment",), config.LabelsConfig, of_all_ladders=True),
    "photo_instances": StageKind(("scene", "segment"), of_all_ladders=True, command="instances"),
    "lift": StageKind(("masks",), of_all_ladders=True),
    "blocks": StageKind(("lift", "masks"), config.BlocksConfig, of_all_ladders=True, command="train"),
    "train": StageKind(("blocks", "lift", "masks"), config.TrainConfig, of_all_ladders=True),
    "fuse": StageKind(("masks", "train"), of_all_ladders=True),
    "instances": StageKind(("fuse", "photo_instances", "train"), of_all_ladders=True),
    "clean": StageKind(("masks", "train"), config.CleanConfig, of_all_ladders=True),
    "base": StageKind(("clean", "train"), config.TrainConfig, command="nest"),
    "nest": StageKind(("base", "clean", "fuse", "instances", "train"), config.NestConfig),
    "interior": StageKind(("nest",), command="nest"),
    "boundaries": StageKind(("interior",), command="nest"),
    "borders": StageKind(("nest",), again="inputs", command="nest"),
    "observe": StageKind(("fuse", "nest", "train"), config.FitConfig, again="inputs"),
    "sample": StageKind(("nest",), config.SampleConfig, again="inputs"),
    "fit": StageKind(("observe", "sample"), config.FitConfig, again="inputs"),
    "plan": StageKind(("fit", "observe", "sample"), config.PlanConfig, again="inputs"),
    "compose": StageKind(("plan",), again="always"),
    "evaluate": StageKind(("compose", "fit", "plan"), again="always"),
    "report": StageKind(("evaluate",), again="always"),
    "crossview": StageKind(("fit", "plan"), again="inputs"),
    "same_size": StageKind(("fit", "plan"), again="inputs", command="report --paper"),
    "paper": StageKind(("crossview", "same_size"), again="inputs", command="report --paper"),
    "pruned": StageKind(("nest", "train"), command="compare"),
    "mcmc": StageKind(("train",), command="compare"),
    "compare": StageKind(("mcmc", "plan", "pruned")),
    "compared": StageKind(("compare",), again="inputs", command="compare"),
}


def stage_kind(stage: str) -> StageKind:
    """What is known of a stage; KeyError for one that is not in the table."""
    return STAGES[stage.partition("-")[0]]


def command_of(stage: str) -> str:
    """The command that does a stage, as it is typed."""
    return f"sagesplat {stage_kind(stage).command or stage.replace('_', '-')}"


def needed_for(stage: str) -> set[str]:
    """The stages that a stage is made of, directly or through others."""
    needs = stage_kind(stage).needs
    return set(needs).union(*map(needed_for, needs))


def following(stage: str) -> list[str]:
    """The stages that are made of a stage's result, directly or through others, in their order."""
    return [name for name in STAGES if stage.partition("-")[0] in needed_for(name)]
