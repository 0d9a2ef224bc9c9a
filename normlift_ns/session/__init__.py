"""Viewer-independent session: prompts, selections, hidden Gaussians and undo, without a browser.

Everything that is shown is an immutable `State`. Each action returns a new state, and a `History` is a list of states.
A viewer keeps one `SelectionContext` per run, and one `History` per user::

    space = SelectionContext(field, means)               # shared by all users; caches answers and the neighbor graph
    history = History.of(State(space), lean=State.without_caches)
    prompts = encode_prompts("red, round mug; sky blue", encoder.rows)    # slow: without holding a lock
    prompts, question = build_query(field, prompts, encoder.rows)         # rows that cannot be encoded keep their error
    history = history.do(actions.ask(history.now, prompts, question))
    history = history.do(actions.set_threshold(history.now, 0.6), key="threshold")  # a slider drag is one step
    history = history.do(actions.click(history.now, weights, "add"))      # the connected object under a ray
    history = history.do(actions.hide(history.now))                       # adds to what is hidden already
    history = history.undo()
    history.now.selection, history.now.drawn, history.now.answer          # what the viewer draws

Slow work runs with a token from `RequestTokens`: the viewer shows that it is busy, and drops stale results.

* `prompts`: prompts and clicks as rows, each with its vector or its error, and the queries made of them.
* `selection`: the field and the centers of its Gaussians; connected objects, growing and shrinking.
* `region`: visible Gaussians inside a polygon or the trace of a brush in a view.
* `state`: what is asked, selected and hidden; layers; undo and redo; tokens of requests.
* `actions`: functions from one state to the next; histograms, suggested thresholds, and prompts that are probably not
  in the scene.
* `objects`: objects of a selection, and camera positions to look at them from.
* `outputs`: files of a selection, and storage of prompts in a run.
"""
