"""What a person does in a viewer, whichever viewer it is, without a browser: asks, selects, hides, and takes it back.

Everything that is shown is a `State`, which is never changed: every action returns another one, and a `History` is a
list of them. A viewer keeps one `Space` per run, and one `History` per person::

    space = Space(field, means)                          # shared by all persons; caches answers and the neighbour graph
    history = History.of(State(space), lean=State.lean)
    prompts = read_prompts("red, round mug; sky blue", encoder.rows)      # slow: outside of any lock
    prompts, question = pose(field, prompts, encoder.rows)                # rows that cannot be read keep their problem
    history = history.do(actions.ask(history.now, prompts, question))
    history = history.do(actions.threshold(history.now, 0.6), key="threshold")  # drags of a slider are one step
    history = history.do(actions.click(history.now, weights, "add"))      # the connected object under a ray
    history = history.do(actions.hide(history.now))                       # hides add up
    history = history.undo()
    history.now.selection, history.now.drawn, history.now.answer          # what the viewer draws

What can be slow runs under a ticket of `Turns`, so that the button shows that it works and late answers are dropped.

* `prompts`: texts and clicks as rows, each with its vector or its problem; questions of them, and of what is saved.
* `space`: the field and the places of the Gaussians; components, growing and shrinking over the neighbour graph, boxes.
* `state`: what is asked, selected and hidden. `actions`: what a person can do about it.
* `verdicts`: histograms, suggested thresholds, and what is probably not in the scene.
* `history`: undo and redo. `found`: the objects of a selection. `turns`: busy or stale. `colours`: of the prompts.
"""
