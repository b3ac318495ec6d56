"""`rootsopt --completion`: the script names every command, option and key, and bash runs it."""

import re
import shutil
import subprocess

import pytest

from rootsopt.commands import completion
from rootsopt.commands.console import COMMANDS, main


@pytest.fixture(scope="module")
def bash():
    return completion.script("bash")


def completed(script, words):
    given = " ".join(f"'{word}'" for word in words)
    code = f"COMP_WORDS=({given}); COMP_CWORD={len(words) - 1}; _rootsopt 2>/dev/null; "
    code += 'printf "%s\\n" "${COMPREPLY[@]}"'
    return subprocess.check_output(["bash", "--norc", "-c", f"{script}\n{code}"], text=True).split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "first"),
    [
        (["si"], ["simulate"]),
        (["optimize", "--res"], ["--resume"]),
        (["simulate", "--set", "scene.timing_gear.b"], ["scene.timing_gear.backlash_mm="]),
        (["simulate", "ci"], ["cic", "cic_drawn"]),
    ],
)
def test_commands_options_and_keys_are_completed(bash, words, first):
    assert completed(bash, ["rootsopt", *words]) == first


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_the_help_is_in_the_script(command, bash, capsys):
    """The script has a command's own options, not only those that all commands share."""
    with pytest.raises(SystemExit, match=r"^0$"):
        main([command, "--help"])
    told = re.findall(r"^  (?:-\w[^,]*, )?(--[\w-]+)", capsys.readouterr().out, re.M)
    wanted = set(told) - {"--help"}
    own = {"explore": {"--set", "--port"}, "new": {"--lobes"}}.get(command, {"--set", "--report"})
    assert own <= wanted
    (line,) = re.findall(rf"^_shtab_rootsopt_{command}_option_strings=\((.*?)\)$", bash, re.M)
    assert wanted <= {word.strip("'") for word in line.split()}


def test_zsh_has_a_script():
    text = completion.script("zsh")
    assert text.startswith("#compdef rootsopt")
    assert "scene.timing_gear.backlash_mm=" in text


def test_unknown_shell_and_missing_library(monkeypatch, capsys):
    assert main(["--completion", "tcsh"]) == 2
    assert "bash or zsh" in capsys.readouterr().err
    monkeypatch.setattr(completion.importlib.util, "find_spec", lambda name: None)
    assert main(["--completion", "bash"]) == 2
    assert "rootsopt[completion]" in capsys.readouterr().err
