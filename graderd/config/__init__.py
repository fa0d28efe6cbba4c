"""The configuration: pydantic models, loader with errors a person can act on."""

from graderd.config.loader import ConfigError, load, parse, parse_section
from graderd.config.models import Config

__all__ = ["Config", "ConfigError", "load", "parse", "parse_section"]
