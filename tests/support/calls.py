"""Count calls of a function."""


def calls_of(monkeypatch, module, name):
    """A list that grows by 1 whenever a function of a module is called."""
    calls, original = [], getattr(module, name)

    def counted(*arguments):
        calls.append(1)
        return original(*arguments)

    monkeypatch.setattr(module, name, counted)
    return calls
