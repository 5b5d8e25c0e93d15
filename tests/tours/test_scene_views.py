"""The panoramas of scenes and predictions."""

from pansplat.tours.scene_views import choose_predictions, choose_scene_views, choose_sources, leave_out


def test_the_scene_of_an_edge_holds_both_ends_and_shares_a_third(make_tour):
    places = ((0, 0), (0, 1), (1, 0), (3, 0), (3, 0.1))
    tour = make_tour(places, ((0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (2, 4)))
    scenes = choose_scene_views(tour)
    assert scenes[0, 1] == scenes[0, 2] == scenes[1, 2] == (0, 1, 2)
    assert scenes[2, 3] == scenes[3, 4] == (2, 3, 4)
    for edge, views in scenes.items():
        assert set(edge) <= set(views)
    assert choose_scene_views(make_tour(places, ((0, 1), (2, 3))))[2, 3] == (2, 3)


def test_panoramas_are_predicted_with_their_part_or_with_a_piece_of_a_large_one(make_tour, home):
    assert choose_predictions(home, 3) == {}, "a network has scenes of edges"
    predictions = choose_predictions(home, 64)
    assert predictions == {0: (0, 1, 2), 1: (0, 1, 2), 2: (0, 1, 2), 3: (3,), 4: (4, 5), 5: (4, 5), 6: (6,)}
    assert set(predictions.values()) == set(choose_sources(home, 64)), "those of one scene of all panoramas"
    row = make_tour([(0, k) for k in range(40)], [(k, k + 1) for k in range(39)])
    predictions = choose_predictions(row, 64)
    assert set(predictions) == set(range(40)) and len(set(predictions.values())) == 3
    for node, views in predictions.items():
        assert {node, *row.find_edge(node)} <= set(views) and len(views) <= 16
    members = [sum(node in views for views in set(predictions.values())) for node in range(40)]
    assert max(members) <= 2 and sum(members) <= 44, "nothing is predicted more than twice"


def test_panoramas_too_close_for_depth_get_a_third(make_tour):
    tour = make_tour(((0, 0), (0, 0.1), (0, 2)), ((0, 1), (1, 2)))
    assert choose_scene_views(tour)[0, 1] == (0, 1, 2)


def test_a_panorama_is_left_out_of_the_scene_that_the_others_show_at_its_position(make_tour):
    tour = make_tour(((0, 0), (0, 1), (0, 2), (9, 0), (9, 1)), ((0, 1), (1, 2), (0, 2), (3, 4)))
    left_out = leave_out(tour, 1)
    assert [view.name for view in left_out.context] == [tour.panoramas[k].name for k in (0, 2)]
    assert left_out.targets == (tour.panoramas[1],) and left_out.name == tour.panoramas[1].name
    alone = leave_out(tour, 3)
    assert [view.name for view in alone.context] == [tour.panoramas[4].name], "the other one of its part"
