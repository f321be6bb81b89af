"""The contract of an option: its YAML registers a class, and has all parameters of it."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from framework.commands.installation.plugins import registered
from framework.config.composition import composed
from framework.registry import GROUPS, build, find_class, parameters


class OptionContract:
    """Builds the plugin as a run would, by the name of its option. Comes first among the bases of a test's class."""

    stage: str  # from the contract of the stage
    option: str
    overrides: tuple[str, ...] = ()  # what only a user knows: ("detector.weights=FILE",)

    def plugin(self) -> Any:
        return build(GROUPS[self.stage], self.node())

    def node(self) -> DictConfig:
        others = [f"~{stage}" for stage in GROUPS if stage != self.stage]
        node: DictConfig = composed(f"{self.stage}={self.option}", *others, *self.overrides)[self.stage]
        return node

    def test_option_is_listed_with_every_parameter_and_a_comment(self) -> None:
        [listed] = registered(self.stage, only=self.option)
        assert listed.documentation, "the class has no docstring"
        assert not listed.documentation.startswith("cannot be used"), listed.documentation
        named = {parameter.name for parameter in listed.parameters}
        assert named == set(map(str, self.node())) - {"_target_"}, "the YAML has every parameter"
        bare = [parameter.name for parameter in listed.parameters if not parameter.comment]
        assert not bare, f"in the YAML, a comment says what these are: {bare}"

    def test_values_in_the_yaml_are_the_defaults_of_the_class(self) -> None:
        node = self.node()
        plugin_class = find_class(GROUPS[self.stage], str(node["_target_"]))
        of_the_user = [override.partition("=")[0].partition(".")[2] for override in self.overrides]
        bare = OmegaConf.masked_copy(node, ["_target_", *of_the_user])
        given, default = (parameters(self.option, plugin_class, of) for of in (node, bare))
        assert given == default
