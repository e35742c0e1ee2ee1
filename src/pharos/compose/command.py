"""The command compose, under the name of its module in releases up to 0.2."""
from pharos.commands.compose import main  # noqa: F401
