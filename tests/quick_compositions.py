"""Hydra's compositions without what it does anew for each: the suite composes more than a thousand times."""

from __future__ import annotations

import copy
import dataclasses
import functools
import os
import pickle
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import hydra
import omegaconf
from hydra import version
from hydra._internal import config_loader_impl, defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from heatsplat.composition import CONF


@contextmanager
def quick_compositions() -> Iterator[None]:
    """While it lasts, a composition takes 0.1 s in place of 0.25 s, and one that is asked for again next to nothing.

    What is found beside further folders (``hydra.searchpath``) is read anew; tests write those.
    """
    parse = functools.cache(omegaconf.base.parse)
    read, merge = ConfigRepository.load_config, ConfigLoaderImpl._compose_config_from_defaults_list
    place = ConfigLoaderImpl._load_single_config
    replaced = (
        (hydra, "compose", _composed_once(hydra.compose)),
        (ConfigRepository, "load_config", _read_once(read)),
        (ConfigLoaderImpl, "_compose_config_from_defaults_list", _merged_once(merge)),
        (ConfigLoaderImpl, "_load_single_config", _once(place, _file)),
        (config_loader_impl, "create_defaults_list", _listed_once(defaults_list.create_defaults_list)),
        (OverridesParser, "parse_rule", _parsed_once(OverridesParser.parse_rule)),
        (HydraConfig, "set_config", _set_config),
        (ConfigRepository, "_find_object_source", _found_once(ConfigRepository._find_object_source)),
        (omegaconf.base.Box, "_re_parent", _re_parent),
        (defaults_list, "_create_interpolation_map", _where_needed(defaults_list._create_interpolation_map)),
        (version, "_get_version", functools.cache(version._get_version)),  # asked for eight hundred times
        (omegaconf.base, "parse", parse),
        (omegaconf._utils, "parse", parse),
    )
    added = (
        (omegaconf.base.Metadata, "__deepcopy__", _copied),
        (ConfigStore, "__deepcopy__", lambda self, memo: self),  # it copies what it gives
    )
    with ExitStack() as stack:
        for owner, name, function in replaced:
            stack.enter_context(mock.patch.object(owner, name, function))
        for owner, name, function in added:
            stack.enter_context(mock.patch.object(owner, name, function, create=True))
        yield


def _composed_once(compose: Callable) -> Callable:
    """``hydra.compose``; planning a budget composes the same five times."""
    known: dict[Any, bytes] = {}  # as bytes here and below: what is returned gets changed

    def composed(config_name=None, overrides=(), return_hydra_config=False):
        places = [place.path for place in GlobalHydra.instance().config_loader().get_search_path().get_path()]
        files = [place.removeprefix("file://") for place in places if not place.startswith(("pkg://", "structured://"))]
        if files != [CONF] or any("searchpath" in text for text in overrides):
            return compose(config_name, list(overrides), return_hydra_config)
        key = config_name, tuple(overrides), return_hydra_config, os.getcwd()
        if key in known:
            return pickle.loads(known[key])
        found = compose(config_name, list(overrides), return_hydra_config)
        known[key] = pickle.dumps(found)
        return found

    return composed


def _parsed_once(parse: Callable) -> Callable:
    """Overrides, of which most runs of tests have the same twenty; what is swept is parsed anew."""
    known: dict[str, Override] = {}

    def parsed(self, s, rule_name):
        if rule_name != "override":
            return parse(self, s, rule_name)
        if s not in known:
            found = parse(self, s, rule_name)
            if found.is_sweep_override():
                return found
            known[s] = found
        return copy.copy(known[s])  # whose loader is set

    return parsed


def _set_config(self: HydraConfig, cfg: DictConfig) -> None:
    """As Hydra's, which copies the settings of Hydra node by node; here they are shared with the configuration, which loses them
    next or is theirs to the end of a job."""
    OmegaConf.set_readonly(cfg.hydra, True)
    self.cfg = OmegaConf.create()
    self.cfg.__dict__["_content"]["hydra"] = cfg._get_node("hydra")


def _ours(sources: Any) -> bool:
    return [source.path for source in sources if source.scheme() == "file"] == [CONF]


class _Read(ConfigResult):
    """A file as it was read; most are asked for their place and their defaults alone, and only some for their settings."""

    def __init__(self, result: ConfigResult) -> None:
        self.__dict__.update(vars(result), settings=pickle.dumps(result.config))
        del self.config

    def again(self) -> _Read:
        new = object.__new__(_Read)
        new.__dict__.update(self.__dict__)
        return new

    def __getattr__(self, name: str) -> Any:
        if name != "config" or "settings" not in self.__dict__:
            raise AttributeError(name)
        self.config = pickle.loads(self.settings)
        return self.config


def _read_once(read: Callable) -> Callable:
    """A file of settings, or None where there is none."""
    known: dict[str, _Read | None] = {}

    def called(self, config_path):
        if not _ours(self.sources):
            return read(self, config_path=config_path)
        if config_path not in known:
            found = read(self, config_path=config_path)
            known[config_path] = None if found is None else _Read(found)
        return known[config_path] and known[config_path].again()

    return called


def _found_once(find: Callable) -> Callable:
    """Where a file or a group is; most groups are looked for in two places, dozens of times for each composition."""
    known: dict[Any, int | None] = {}

    def found(self, config_path, object_type):
        if not _ours(self.sources):
            return find(self, config_path, object_type)
        key = config_path, object_type, tuple(source.path for source in self.sources)
        if key not in known:
            source = find(self, config_path, object_type)
            known[key] = None if source is None else self.sources.index(source)
        return None if known[key] is None else self.sources[known[key]]

    return found


def _once(function: Callable, about: Callable) -> Callable:
    """A function of files: ``about`` says from which sources, and what tells one call from another."""
    known: dict[Any, bytes] = {}

    def called(self, **arguments):
        sources, key = about(self, **arguments)
        if not _ours(sources):
            return function(self, **arguments)
        if key not in known:
            known[key] = pickle.dumps(function(self, **arguments))
        return pickle.loads(known[key])

    return called


def _file(self: Any, default: Any, repo: Any) -> tuple[Any, str]:
    return repo.get_sources(), repr(dataclasses.astuple(default))


def _merged_once(merge: Callable) -> Callable:
    """Files merged one after the other: what a list begins with as one before did is not merged again."""
    known: dict[tuple[str, ...], bytes] = {}  # files -> all of them, merged
    begun: dict[tuple[str, ...], bytes] = {}  # files at the beginning of lists
    before: tuple[str, ...] = ()

    def called(self, defaults, repo):
        nonlocal before
        if not _ours(repo.get_sources()):
            return merge(self, defaults=defaults, repo=repo)
        files = tuple(repr(dataclasses.astuple(one)) for one in defaults)
        if files in known:
            return pickle.loads(known[files])
        start = next((k for k in range(len(files), 0, -1) if files[:k] in begun), 0)
        shared = next((k for k, (one, other) in enumerate(zip(files, before, strict=False)) if one != other), 0)
        before = files
        config = pickle.loads(begun[files[:start]]) if start else OmegaConf.create()
        try:
            with flag_override(config, "no_deepcopy_set_nodes", True):
                for k, default in enumerate(defaults[start:], start):
                    if k == shared > start:
                        with flag_override(config, "no_deepcopy_set_nodes", None):
                            begun[files[:k]] = pickle.dumps(config)
                    config.merge_with(self._load_single_config(default=default, repo=repo).config)
        except OmegaConfBaseException:
            return merge(self, defaults=defaults, repo=repo)  # which names the file
        _without_defaults(config)
        known[files] = pickle.dumps(config)
        return config

    return called


def _without_defaults(config: Any) -> None:
    """Takes lists of defaults away, as Hydra does when all is merged."""
    if config._is_missing() or config._is_none():
        return
    if config._get_flag("HYDRA_REMOVE_TOP_LEVEL_DEFAULTS"):
        with flag_override(config, ["readonly", "struct"], False):
            config._set_flag("HYDRA_REMOVE_TOP_LEVEL_DEFAULTS", None)
            config.pop("defaults", None)
    content = config.__dict__["_content"]
    for value in content.values() if isinstance(content, dict) else ():
        if isinstance(value, DictConfig):
            _without_defaults(value)


def _listed_once(listed: Callable) -> Callable:
    """A list of files to merge, which depends on the options that are chosen, and not on other settings."""
    known: dict[str, Any] = {}

    def called(repo, config_name, overrides_list, prepend_hydra, skip_missing):
        chosen = defaults_list.Overrides(repo, overrides_list)
        about = chosen.override_choices, chosen.append_group_defaults, chosen.deletions
        key = repr((config_name, about, prepend_hydra, skip_missing))
        if not _ours(repo.get_sources()):
            return listed(repo, config_name, overrides_list, prepend_hydra, skip_missing)
        if key not in known:
            known[key] = listed(repo, config_name, overrides_list, prepend_hydra, skip_missing)
        return dataclasses.replace(known[key], config_overrides=chosen.config_overrides)

    return called


def _re_parent(self: Any) -> None:
    """As OmegaConf's, which asks every node of the whole configuration for its kind, after each of the merged files."""
    content = self.__dict__["_content"]
    held = isinstance(content, (dict, list))
    for child in (content.values() if isinstance(content, dict) else content) if held else (content,):
        if isinstance(child, omegaconf.Node):
            state = child.__dict__
            state["_parent"], state["_flags_cache"] = self, None
            if "_content" in state:
                child._re_parent()


def _where_needed(map_of: Callable) -> Callable:
    """A map of all choices, which Hydra makes for each of some thirty files and reads only where a default depends on another."""

    def choices(overrides, defaults, self_added):
        depends = [str(one.get_name()) for one in defaults if not one.is_self() and not one.is_override()]
        depends = [name for name in depends if "${" in name]
        if any("defaults" in name for name in depends):  # by its place in a list
            return map_of(overrides, defaults, self_added)
        return OmegaConf.create(overrides.known_choices) if depends else None

    return choices


def _copied(self: Any, memo: dict[int, Any]) -> Any:
    """What OmegaConf knows of a node, copied attribute by attribute: names, types and flags, thousands of times."""
    new = object.__new__(type(self))
    cache = copy.deepcopy(self.resolver_cache, memo) if self.resolver_cache else defaultdict(dict)
    new.__dict__.update(self.__dict__, flags=copy.copy(self.flags), resolver_cache=cache)
    return new
