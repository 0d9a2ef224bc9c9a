"""Viewer-independent session: prompts, selections, hidden Gaussians and undo, without a browser.

An immutable `State` describes the query, the selection and the hidden Gaussians of one user. Each action returns a new
state, and a `History` is a list of states. A viewer keeps one `SelectionContext` per run, and one `History` per user::

    space = SelectionContext(field, means)               # shared by all users; caches answers and the neighbor graph
    history = History.of(State(space), lean=State.without_caches)
    prompts = encode_prompts("red, round mug; sky blue", encoder.rows)    # slow, so do not hold a lock
    prompts, question = build_query(field, prompts, encoder.rows)         # rows that cannot be encoded keep their error
    history = history.do(actions.ask(history.now, prompts, question))
    history = history.do(actions.set_threshold(history.now, 0.6), key="threshold")  # a slider drag is one step
    history = history.do(actions.click(history.now, weights, "add"))      # the connected object under a ray
    history = history.do(actions.hide(history.now))                       # in addition to hidden Gaussians
    history = history.undo()
    history.now.selection, history.now.drawn, history.now.answer          # what the viewer draws

Slow work runs with a token from `RequestTokens`. The viewer uses the token to show that work is running, and to discard
stale results.

* `prompts`: prompts and clicks as rows, each with its vector or its error, and queries made from these rows.
* `selection`: field and centers of the Gaussians; objects around a Gaussian; growing and shrinking of selections.
* `region`: visible Gaussians inside a polygon or along a brush stroke in a view.
* `state`: query, selection, hidden Gaussians and layers, with undo, redo and request tokens.
* `actions`: functions from one state to the next, with histograms, suggested thresholds and warnings about prompts.
* `objects`: objects of a selection, and camera positions that show them.
* `outputs`: files of a selection, and storage of prompts in a run.
"""
