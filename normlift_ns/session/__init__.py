"""Viewer-independent session: what a user asks, selects, hides and undoes in any viewer, without a browser.

Everything that is shown is an immutable `State`. Each action returns a new state, and a `History` is a list of states.
A viewer keeps one `Space` per run, and one `History` per user::

    space = Space(field, means)                          # shared by all users; caches answers and the neighbor graph
    history = History.of(State(space), lean=State.without_caches)
    prompts = read_prompts("red, round mug; sky blue", encoder.rows)      # slow: without holding a lock
    prompts, question = pose(field, prompts, encoder.rows)                # rows that cannot be encoded keep their error
    history = history.do(actions.ask(history.now, prompts, question))
    history = history.do(actions.threshold(history.now, 0.6), key="threshold")  # a slider drag is one step
    history = history.do(actions.click(history.now, weights, "add"))      # the connected object under a ray
    history = history.do(actions.hide(history.now))                       # adds to what is hidden already
    history = history.undo()
    history.now.selection, history.now.drawn, history.now.answer          # what the viewer draws

Slow work runs with a token from `Turns`: the viewer shows that it is busy, and drops stale results.

* `prompts`: prompts and clicks as rows, each with its vector or its error, and the queries made of them.
* `space`: the field and the centers of its Gaussians; connected objects, growing and shrinking, boxes.
* `state`: what is asked, selected and hidden. `actions`: functions from one state to the next.
* `verdicts`: histograms, suggested thresholds, and prompts that are probably not in the scene.
* `history`: undo and redo. `found`: objects of a selection. `viewpoint`: camera positions to look at them from.
* `turns`: tokens of requests. `worker`: job queue. `colours`: colors of prompts.
"""
