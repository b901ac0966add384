"""What stands around a training loop: a run's options and recipe, its fingerprint, its line of progress.

The command line wins over the character's recipe ([training] in its TOML), the recipe over the defaults.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib
import sys
from pathlib import Path

import numpy as np

from plumbing.cli import UserError, cli, given_flags
from plumbing.runs import CONFIG, check_run, read_config, stored_options

CHANGEABLE = ("steps", "threads", "resume", "out", "address")  # what may differ when a run is resumed
TOGETHER = {"extras.train", "extras.cluster"}  # go on with one another's runs


def read_options(kind, argv, prog, description, widths=None):
    """The options of a new run, or of the one to resume.

    Args      kind : a dataclass that is a `character.Switches` with out, resume, init and recipe; argv : list of str
              widths : of --init's policy, (path, character) -> {option: value}, where the command line does not say
    Raises    UserError: a run is there already, or none to resume; the recipe holds what `kind` has not
    Test      tests/test_ppo.py::test_recipe, test_resume_refuses_other_options, test_init_brings_its_widths
    """
    opt, given = cli(kind, argv, prog, description), given_names(argv)
    opt = dataclasses.replace(opt, out=opt.out or f"runs/{Path(opt.character).stem}")
    check_run(opt.out, opt.resume)
    if opt.resume:
        return with_a_note(resumed_options(opt, argv))
    char, recipe = opt.load(), {}
    if opt.recipe != "none":
        recipe = {k: tuple(v) if isinstance(v, list) else v for k, v in char.training.items() if k != "by"}
    if odd := sorted(set(recipe) - {f.name for f in dataclasses.fields(kind)}):
        raise UserError(
            f"{char.path}: [training] {', '.join(odd)}: no option of {prog}; "
            'valid: by = "extras.train", which has it, or --recipe none'
        )
    if told := [f"{k} {shown(v)}" for k, v in recipe.items() if k not in given]:
        print(f"recipe, [training] of {char.path.name}: {', '.join(told)}")
    if opt.init and widths:
        recipe |= widths(opt.init, opt.character)
    return dataclasses.replace(opt, **{k: v for k, v in recipe.items() if k not in given})


def shown(value) -> str:
    """A hyper-parameter as a command line has it.  Test: tests/test_ppo.py::test_recipe"""
    return ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def with_a_note(opt):
    """The options of a run that goes on; a line where the recipe of today has it otherwise, for it is read but once.

    Test      tests/test_ppo.py::test_resume_refuses_other_tables"""
    char = opt.load()
    odd = [
        f"{k} {shown(getattr(opt, k))} (recipe: {shown(v)})"
        for k, v in (char.training.items() if opt.recipe != "none" else ())
        if hasattr(opt, k) and not (opt.init and k in ("hidden", "value_hidden")) and shown(getattr(opt, k)) != shown(v)
    ]
    if odd:
        print(f"goes on as it began, not by today's [training] of {char.path.name}: {', '.join(odd)}")
    return opt


def given_names(argv) -> set:
    """Names of the fields that a command line sets, --no-x being one of x.

    Test      tests/test_ppo.py::test_recipe"""
    return {name.removeprefix("no_") for name in given_flags(argv)}


def resumed_options(opt, argv, changeable=CHANGEABLE):
    """The stored options of the run in opt.out; the command line may change only what keeps the run the same run.

    Args      changeable : names of options that may differ; the first two are told
    Raises    UserError: a given option differs from the stored one
    Test      tests/test_ppo.py::test_resume_refuses_other_options, tests/drop/test_drop_vae.py::test_command,
              tests/skeletal/test_skeletal_play.py::test_autoencode_command, test_train_command
    """
    check_run(opt.out, resume=True)
    by, own = read_config(opt.out)["config"].get("by"), getattr(type(opt), "BY", None)
    if by and own and by != own and {by, own} - TOGETHER:  # before anything is written
        raise UserError(f"{opt.out}: was trained by {by}; valid: python ppo.py --resume --out {opt.out}, or -m {by}")
    stored, given, values = stored_options(type(opt), opt.out), given_names(argv), {}
    for f in dataclasses.fields(opt):
        asked = getattr(opt, f.name)
        values[f.name] = stored.get(f.name, asked)
        if f.name in given and asked != values[f.name]:
            if f.name not in changeable:
                recipe = ", given or by its recipe" if own else ""  # DROP's and the skeletal runs have neither
                anew = f", or start a new run with --init {opt.out}" if own else ""
                raise UserError(
                    f"{opt.out}: was started with --{f.name.replace('_', '-')} {shown(values[f.name])}{recipe}; "
                    f"to resume, leave it out (can change: {', '.join(changeable[:2])}){anew}"
                )
            values[f.name] = asked
    return type(opt)(**values | {"resume": True, "out": opt.out})


def trained_by(switches, argv, own: str) -> str:
    """The module that trains: of the run to resume, else of the character's recipe, else `own`.

    Args      switches : `character.Switches`
    Raises    UserError: no such character
    Test      tests/test_ppo.py::test_recipe, tests/extras/test_train.py::test_ppo_hands_on"""
    if {"-h", "--help"} & set(argv) or value_of(argv, "recipe") == "none":
        return own
    name = value_of(argv, "character") or switches().character
    if "--resume" in argv:
        out = Path(value_of(argv, "out") or f"runs/{Path(name).stem}")
        return str(read_config(out)["config"].get("by", own)) if (out / CONFIG).is_file() else own
    return switches(character=name, set=value_of(argv, "set")).load().training.get("by", own)


def value_of(argv, name) -> str | None:
    """What a command line says for --name, the last time it does.

    Test      tests/test_ppo.py::test_recipe"""
    found = None
    for a, after in zip(argv, [*argv[1:], None]):
        flag, equals, text = a.partition("=")
        if flag == f"--{name}":
            found = text if equals else after
    return found


def main_of(module: str):
    """The `main` of a module of extras.  UserError: there is none

    Test      tests/extras/test_train.py::test_ppo_hands_on"""
    try:
        if module.startswith("extras."):
            return importlib.import_module(module).main
    except (ModuleNotFoundError, AttributeError) as e:
        if getattr(e, "name", module) not in (module, "main"):
            raise
    raise UserError(f"trained by {module[:80]!r}: no such trainer; valid: a module of extras that has a main")


# ------------------------------------------------------------------------------------ around the loop


def fingerprint(array) -> str:
    """Hash of the reference motions: tells whether two runs saw the same data.

    Test      tests/test_ppo.py::test_fingerprint"""
    return hashlib.sha256(np.ascontiguousarray(array)).hexdigest()[:16]


def say_idle(char, without: dict) -> None:
    """A note on stderr where what is left out weighs nothing anyway: the run would be the same with it.

    Args      char : a `character.Character`; without : name -> the terms of its reward
    Test      tests/test_ppo.py::test_without_what_weighs_nothing"""
    for name, terms in without.items():
        if terms and not any(char.reward[term][0] for term in terms):
            says = f"note: --without {name} changes nothing: {char.name}'s reward gives it no weight"
            print(says, file=sys.stderr)


def motions(ref) -> dict:
    """What tells whether two runs saw the same motions, and how much.  Test: tests/test_ppo.py::test_fingerprint"""
    return {"fingerprint": fingerprint(ref.qpos), "sequences": len(ref.names), "minutes": len(ref) / ref.rate / 60}


def tables_of(char) -> dict:
    """What a character's TOML, with --set, says of a run: weights, torques, pose; not how it is trained and measured.

    Why       the file can be edited between two launches, and a run that goes on would follow another reward
    Test      tests/test_ppo.py::test_resume_refuses_other_tables"""
    return {name: table for name, table in char.spec.items() if name not in ("training", "metrics")}


SOLID = (  # arrays of the compiled model on which the physics of a run hangs, and what is seen and counted of it
    "body_mass body_inertia body_pos body_quat body_ipos geom_type geom_size geom_pos geom_quat geom_contype "
    "geom_conaffinity geom_friction geom_solref geom_solimp jnt_pos jnt_axis jnt_range jnt_stiffness dof_armature "
    "dof_damping dof_frictionloss qpos_spring actuator_gear site_pos site_quat"
).split()


def model_of(char) -> dict:
    """Name -> fingerprint of the arrays of a character's compiled model.

    Why       its XML can be edited between two launches as its TOML can
    Test      tests/test_ppo.py::test_resume_refuses_other_tables"""
    option = {"gravity": char.model.opt.gravity, "cone": [char.model.opt.cone]}
    return {name: fingerprint(a) for name, a in ({n: getattr(char.model, n) for n in SOLID} | option).items()}


def differing(before, now: dict) -> list[str]:
    """Names under which two dicts differ; none where `before` is not one, for runs of before 2026-12 kept none.

    Test      tests/test_ppo.py::test_resume_refuses_other_tables"""
    if not isinstance(before, dict):
        return []
    return [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]


def check_same(seen, now, out):
    """UserError unless a run that is resumed sees the motions, and the character's tables and model, that it saw.

    Test      tests/test_ppo.py::test_resume_refuses_other_options, test_resume_refuses_other_tables"""
    kept = seen if isinstance(seen, dict) else {}
    if odd := differing(kept.get("tables"), now.get("tables", {})):
        was = f"{', '.join(f'[{name}]' for name in odd)} of the character's TOML changed since the run began"
        raise UserError(f"{out}: {was}; put it back, as {CONFIG} has it, or start a new run with --init {out}")
    if odd := differing(kept.get("model"), now.get("model", {})):
        was = f"{', '.join(odd)} of the character's model (its XML, or the flags) changed since the run began"
        raise UserError(f"{out}: {was}; put it back, or start a new run with --init {out}")
    if kept.get("fingerprint") != now["fingerprint"]:  # last: another pose makes other motions of the same files
        had, has = (f"{a.get('sequences')} sequences, {str(a.get('minutes'))[:6]} min" for a in (kept, now))
        changed = f"the motions have changed since the run began ({had} then, {has} now)"
        raise UserError(f"{out}: {changed}; start a new run with --init {out}")


def progress_line(stats) -> dict:
    """The numbers of an update that a watcher needs, short.

    Test      tests/test_ppo.py::test_line_of_progress"""
    terms = " ".join(f"{k[2:]} {v:.2f}" for k, v in stats.items() if k.startswith("r_") and v)
    ends = " ".join(f"{k[4:]} {v}" for k, v in stats.items() if k.startswith("end_") and v)
    return {
        "steps/s": f"{stats['steps_per_s']:.0f}",
        "fails every": f"{stats['time_to_failure']:.2f} s" if stats["failures"] else "never",
        "survival": f"{stats['survival']:.2f}",
        "reward": f"{stats['reward']:.2f}",
        "[": f"{terms} ]",
        "ends": ends or "none",
        "kl": f"{stats['kl']:.3f}",
        "clip": f"{stats['clip_fraction']:.2f}",
        "ev": f"{stats['explained_variance']:.2f}",
        "σ": f"{stats['sigma']:.3f}",
    }


@contextlib.contextmanager
def fitting(path):
    """A checkpoint is taken over: UserError, naming path, where it is of another run.

    Test      tests/test_ppo.py::test_resume_refuses_a_foreign_checkpoint"""
    try:
        yield
    except (KeyError, TypeError, ValueError) as e:
        says = f"does not fit this run ({type(e).__name__}: {e}); give another --out, with --init {path}"
        raise UserError(f"{path}: {says}") from None
    except UserError as e:
        raise UserError(f"{path}: {e}") from None


def part_of(arrays, name) -> dict:
    """The arrays called NAME.x, as x.  Test: tests/test_ppo.py::test_resume_is_exact"""
    return {key.partition(".")[2]: value for key, value in arrays.items() if key.startswith(f"{name}.")}


def check_progress(meta):
    """ValueError unless a checkpoint's counts are integers of at least 0, and its learning rate is a rate.

    Test      tests/robustness/test_fuzz.py::test_run_folders"""
    for key in ("steps", "updates", "rows"):
        if type(meta.get(key, 0)) is not int or meta.get(key, 0) < 0:
            raise ValueError(f"{key} is {str(meta[key])[:80]}, valid: an integer of at least 0")
    if type(meta["lr"]) not in (int, float) or not meta["lr"] > 0:
        raise ValueError(f"lr is {str(meta['lr'])[:80]}, valid: a number greater than 0")
