"""What a command is given."""

from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf


def settings_of(config: DictConfig) -> tuple[dict[str, Any], Path]:
    """A configuration as plain data, and the run folder."""
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    return plain, Path(HydraConfig.get().runtime.output_dir)
