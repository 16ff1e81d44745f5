(true p ??m (not (and p (or q (implies r (equiv s t)))))
 (forall ?x (exists ?y (B crex (U crex (PG crex (I crex (= ?x ?y)))))))
 (done (; (action a b) (| (action c d) ??n)) p) (feasible (action a b)) (result (action a b) 1))
