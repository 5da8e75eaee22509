"""The list of mutants fits the code: a mutant whose line has moved would stop the run."""

from tests.mutation.run import ROOT, all_mutants, misplaced


def test_every_mutant_has_its_place():
    assert misplaced(all_mutants()) == []


def test_the_tests_of_every_mutant_exist():
    named = {name.partition("::")[0] for mutant in all_mutants() for name in mutant.tests.split()}
    assert [name for name in sorted(named) if not (ROOT / "tests" / name).exists()] == []
