import jade.core.AID;
import jade.core.Agent;
import jade.core.behaviours.OneShotBehaviour;
import jade.domain.DFService;
import jade.domain.FIPAAgentManagement.DFAgentDescription;
import jade.domain.FIPAAgentManagement.SearchConstraints;
import jade.domain.FIPAAgentManagement.ServiceDescription;
import jade.domain.FIPAException;

/** Uses the directory facilitator of another platform by JADE's DFService: name and address of the facilitator. */
public class DfAgent extends Agent {
    @Override
    protected void setup() {
        final Object[] arguments = getArguments();
        addBehaviour(new OneShotBehaviour(this) {
            @Override
            public void action() {
                AID df = new AID((String) arguments[0], AID.ISGUID);
                df.addAddresses((String) arguments[1]);
                ServiceDescription service = new ServiceDescription();
                service.setName("jade-crane");
                service.setType("lifting");
                DFAgentDescription own = new DFAgentDescription();
                own.setName(getAID());
                own.addServices(service);
                ServiceDescription lifting = new ServiceDescription();
                lifting.setType("lifting");
                DFAgentDescription sought = new DFAgentDescription();
                sought.addServices(lifting);
                SearchConstraints all = new SearchConstraints();
                all.setMaxResults(-1L);
                try {
                    DFService.register(myAgent, df, own);
                    System.out.println("DF registered");
                    try {
                        DFService.register(myAgent, df, own);
                        System.out.println("DF wrong: registered twice");
                    } catch (FIPAException refused) {
                        System.out.println("DF second registration: " + refused.getMessage());
                    }
                    for (DFAgentDescription found : DFService.search(myAgent, df, sought, all)) {
                        System.out.println("DF found " + found.getName().getName());
                    }
                    service.setName("jade-crane-2");
                    DFService.modify(myAgent, df, own);
                    System.out.println("DF modified");
                    DFService.deregister(myAgent, df, own);
                    int left = DFService.search(myAgent, df, sought, all).length;
                    System.out.println("DF deregistered, left " + left);
                    try {
                        DFService.deregister(myAgent, df, own);
                        System.out.println("DF wrong: deregistered twice");
                    } catch (FIPAException refused) {
                        System.out.println("DF second deregistration: " + refused.getMessage());
                    }
                    // A service at JADE's own facilitator, for searches from the other platform.
                    DFService.register(myAgent, own);
                    System.out.println("DF registered at its own platform");
                } catch (FIPAException error) {
                    System.out.println("DF wrong: " + error);
                }
                System.out.println("DF end");
            }
        });
    }
}
