"""What an argument of `dolens train` may become: for the completion of a shell."""

from collections.abc import Sequence

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.completion_plugin import CompletionPlugin

from dolens.experiments.running.resolvers import register_resolvers
from dolens.experiments.running.user_configuration import use_working_folder
from dolens.files import packaged_configuration


class _Completion(CompletionPlugin):
    """Hydra's completion without a shell of its own: Typer talks to the shell."""

    def install(self) -> None:
        """Do nothing: Typer installs it."""

    def uninstall(self) -> None:
        """Do nothing: Typer uninstalls it."""

    @staticmethod
    def provides() -> str:
        """Return no shell's name."""
        return "none"

    def query(self, config_name: str | None) -> None:
        """Do nothing: `completions` asks."""

    @staticmethod
    def help(command: str) -> str:
        """Return nothing: Typer's help is shown."""
        return ""


def completions(before: Sequence[str], incomplete: str) -> list[str]:
    """Return what a word of the command line may become.

    Args:
        before: the words before it.
        incomplete: as far as it is typed.  Bash takes `=` for a word of its own: then it is what
            follows `=`, and so is what is returned.
    """
    words = _rejoined(before)
    head = ""
    if words and words[-1].endswith("="):  # bash, at `lens=co`
        head = words.pop()
    elif words and incomplete == "" and _is_key(words[-1]):  # bash, at `lens=`
        head = f"{words.pop()}="
    register_resolvers()
    use_working_folder()
    with initialize_config_dir(str(packaged_configuration()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        overrides = [word for word in words if "=" in word or word.startswith("~")]
        line = " ".join([*overrides, head + incomplete])
        found = _Completion(loader)._query("train", line)
    return [text.removeprefix(head) for text in found]


def _rejoined(words: Sequence[str]) -> list[str]:
    """Return words with `key`, `=`, `value` put together again."""
    found: list[str] = []
    for word in words:
        if found and (word == "=" or found[-1].endswith("=")):
            found[-1] += word
        else:
            found.append(word)
    return found


def _is_key(word: str) -> bool:
    """Return whether a word is the beginning of an override that has no value yet."""
    return "=" not in word and not word.startswith(("-", "~"))
